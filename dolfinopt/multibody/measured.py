"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

# -- dimension: series of a rotation ---------------------------------------------------------

# Terms up to an angle squared, rad^2: they leave 1e-24 at the first, and 1e-40 up to the second,
# where rounding has grown to 1e-15.
SHORT_SERIES_TERMS = 10
SHORT_SERIES_LIMIT = 1.0
LONG_SERIES_TERMS = 40
LONG_SERIES_LIMIT = 10.0

# -- mechanism, inverse_dynamics -------------------------------------------------------------

LINEAR_DRIVE_SHARE = 0.95  # of its limit, up to which a drive gives what is wanted of it
# Fewer instants are computed as so many. On processors with AVX-512, NumPy 1.24 multiplies complex
# arrays of less than 64 bytes in one of two ways that round differently, and chooses by how far the
# arrays lie from each other in memory: equal runs would end in different bits.
LEAST_INSTANTS = 4
# Change of an arm's stiffness by a motion's loads, from which results without it are not trusted.
STIFFNESS_CHANGE_LIMIT = 0.05

# -- tangent ---------------------------------------------------------------------------------

# Of the derivatives of all frames at instants that are computed together: eight arms in space have
# 0.14 MB an instant. Pieces of this size took 3 % more time than all at once.
DERIVATIVES_BYTES = 128e6

# -- standard_input --------------------------------------------------------------------------

# How far matrices that must be symmetric, or zero, may be from it, relative to their largest
# entry, and places to a length: finite elements leave 1e-12, files with six digits 1e-6.
FILE_ROUNDING_SHARE = 1e-6
# How far the centrifugal matrix may be from that of the mass, relative to Me: lumped masses reach
# 5 %, geometric stiffening by rotation changes the sign of its diagonal for slender bodies.
CENTRIFUGAL_EXCESS_SHARE = 0.1
SAME_NODE_SHARE = 1e-9  # of an arm's extent: nodes of two ranks that are no farther apart are one

# -- ranks -----------------------------------------------------------------------------------

# Singular value over the largest, below which a direction counts for nothing: rounding leaves
# 1e-16; the least that counts was 0.4, of pins that hold flexible arms out of their plane.
RANK_SHARE = 1e-6
