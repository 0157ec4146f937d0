"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

import math

# -- several files ---------------------------------------------------------------------------

# Of the arm's height, or of the extent of a model: coordinates in a file have seven digits or more.
# So, too: sine of a corner's angle, and part of the cube of the longest edge, below which cells are
# flat; what angles about a point exceed a full turn by, rad; cosine to z of a side face's normal,
# and what is missing to 1 of an end face's; distance of a facet's midpoint from the foot of the
# perpendicular through the cell's centroid, in lengths of the facet, up to which the filter takes a
# cell for a rectangle or an equilateral triangle.
FILE_ROUNDING_SHARE = 1e-6
# How far an interface's middle may be off its joint axis and the mesh's height off `height`,
# relative to `height`: far more than a polygon in place of a circle needs.
FRAME_TOLERANCE = 0.05

# -- arm_mesh --------------------------------------------------------------------------------

# Of a cell: a node is so near to its line of the grid by rounding; of an interface's radius, by
# which sides may lie beyond it; of an arm's length, up to which places are one; of the longest line
# squared, for lines that meet at an end; of a sample of widths, beyond its cell.
GRID_ROUNDING_SHARE = 1e-9

# -- budget ----------------------------------------------------------------------------------

# Peak memory beyond the libraries of one simulation with its gradient, two arms of n
# quadrilaterals on one rank, DOLFINx 0.5.2, one thread: n = 9 600: 265 MB; 38 400: 648 MB; 86 400:
# 1307 MB; 153 600: 2279 MB. Quadratic elements take 1.3 times as many bytes a node.
RANK_BYTES = 0.2e9  # of a rank without cells
CELL_BYTES = 7.2e3  # of a cell with one node
# Bytes of a hexahedron over those of a quadrilateral, with conjugate gradients, which replace the
# factor where memory is short: 378 000 dofs 3.1 GB, 996 000 8.2 GB (`dolfinopt bench solid`); and
# of a solid arm on several ranks over one on one: 12.7 GB.
SOLID_BYTES_RATIO = 3.6
SHARED_BYTES_RATIO = 1.5
# Bytes a cell of a solid from a file, whose cells are all different: without and with geometric
# stiffness, which takes the stress of 18 loads in all cells. A bar of 17 605 tetrahedra of second
# order takes 1.33 and 1.83 GB, one of 16 755 of first order 0.23 and 0.46 GB, one of 4468 hexahedra
# 0.28 and 0.42 GB. Of other elements by their nodes.
FILE_CELL_BYTES = {
    ("tetrahedron", "quadratic"): (75e3, 104e3),
    ("tetrahedron", "linear"): (14e3, 28e3),
    ("hexahedron", "incompatible"): (62e3, 95e3),
}

# -- geometry --------------------------------------------------------------------------------

# Extents that are those of the arm in another unit, within this factor: flanges stick out.
UNIT_FACTOR = 2.0
INP_BYTES_LIMIT = 2_000_000_000  # of a .inp file: 10 million nodes
THICKNESS_TOLERANCE = 1e-3  # relative, of a solid: sheet metal is made no closer

# -- sections: incompatible hexahedra, against beam theory (test_uniform_members.py) -------------

SECTION_CELLS = 4  # of the sides between the walls, and of the thickest wall
ROUND_CELLS = 24  # around a tube
SECTION_LEAST_ALONG = 24  # cells along, half as long as the section's larger side at most
# Where the first cell along is cut, and likewise the last: the rigid interface holds the section's
# width there, which would stiffen whole cells (tubes by 1.1 % in bending instead of 0.3 %).
SECTION_END_CELLS = (0.125, 0.4)
# Length of a hollow box's cells at its corners over its wall. Torsion of 100 x 100 x 2.5 mm
# is too stiff by 8 % without them (against Prandtl's stress function), with 2 by 1.4 %, 1.5 by
# 0.8 %, 1.25 by 0.5 %, 1.1 by 0.4 %: then the cells' inner sides are a tenth of the wall.
CORNER_CELL_RATIO = 1.25

# -- file_check, gmsh_session ----------------------------------------------------------------

WORD_CHARACTERS_LIMIT = 250  # of a name, number or text; Gmsh's parser has buffers of 256 and 1024
LINE_CHARACTERS_LIMIT = 1000  # of a line that Gmsh sees; it reads blocks of 8192
UNREAD_STATEMENTS_LIMIT = 1000  # of a .geo file that Gmsh gave up: no file of an arm has more

# -- solid_cells -----------------------------------------------------------------------------

# By how much nodes may be off a bore's radius: CAD programs place them to 1e-6, converters in
# single precision to 1e-4, facets of stl files with 12 sides by 3 %.
BORE_RADIUS_SHARE = 0.02
FACES_EDGE_ANGLE = math.radians(40.0)  # between triangles, from which on it parts two faces
LOST_VOLUME_SHARE = 0.1  # largest one that flat cells may miss at curved faces
