"""From density to part: the outline of every arm, its curves, and the files for the workshop.

domain: what is given of an arm. outline: where its material ends, a polygon at a level of the
density (levels, search, polygons). smooth: lines, arcs and splines along that polygon (trace,
pieces, fit, mirror, area, arcs), which are a shape. files: STEP, DXF, SVG and STL of shapes.
part: all of it for the arms of a run. isosurface: surfaces of solids' designs.
solid_part: parts of solid arms (solid_domain, solid_level, smooth_surface, solid_widths),
solid_files: their STL and 3MF; solid_check: what they do in the machine (solid_mesh, solid_stress).
"""
