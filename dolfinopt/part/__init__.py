"""From density to part: the outline of every arm, its curves, and the files for the workshop.

domain: what is given of an arm. outline: where its material ends, a polygon at a level of the
density (levels, search, polygons). smooth: lines, arcs and splines along that polygon (trace,
pieces, fit, mirror, area, arcs), which are a shape. files: STEP, DXF, SVG and STL of shapes.
part: all of it for the arms of a run. isosurface: surfaces of solids' designs.
solid_part: parts of solid arms (smooth_surface), solid_files: their STL and 3MF.
"""
