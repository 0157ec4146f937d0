"""One arm of the scene: design variables in, reduced body out."""
