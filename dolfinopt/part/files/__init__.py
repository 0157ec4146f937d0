"""Files of parts: STEP, DXF, SVG, STL, 3MF, and the scene with the parts in it."""
