"""From density to part: the outline of every arm, its curves, and the files for the workshop.

domain: what is given of an arm. outline: where its material ends. shape: lines, arcs and splines of
that outline. files: STEP, DXF, SVG and STL of a shape.
"""
