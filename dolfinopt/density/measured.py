"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

# -- filter ----------------------------------------------------------------------------------

# Least distance of a centroid from a side, in areas over side lengths, in the stabilisation: 1/2 in
# a parallelogram, 2/3 in a triangle; it may vanish in a quadrilateral that is hardly convex.
LEAST_SIDE_DISTANCE = 0.05
# Largest distance of a cell from the mirror image of its partner, in square roots of its area, in
# space cubic roots of its volume. Meshes of symmetric geometries that were made without a thought
# of symmetry: 0.7 to 1.0.
MIRROR_DISTANCE_LIMIT = 1.25

# -- members ---------------------------------------------------------------------------------

# Samples along a cell of the mean area, and in all: a width is known to a sample.
CELL_SAMPLES = 4
SAMPLES_LIMIT = 1_000_000
# A piece that hangs on the rest by one end is a corner up to this length, in widths, and a member
# beyond. Two straight edges that meet at less than 23 degrees make the longest corners.
CORNER_LENGTH_RATIO = 2.0

# -- designs ---------------------------------------------------------------------------------

GREY = 0.02  # grayness from which on a design is no longer close to any part
