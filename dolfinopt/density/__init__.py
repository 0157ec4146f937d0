"""From design variables to stiffness and mass: filter, projection, interpolation, symmetry."""
