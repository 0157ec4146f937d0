"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

# -- dimension: series of a rotation ---------------------------------------------------------

# Terms up to an angle squared, rad^2, beyond which sine and cosine leave 1e-15 as well: they leave
# 1e-24 there. Interfaces turn by less.
SERIES_TERMS = 10
SERIES_LIMIT = 1.0

# -- mechanism, inverse_dynamics -------------------------------------------------------------

LINEAR_DRIVE_SHARE = 0.95  # of its limit, up to which a drive gives what is wanted of it
# Fewer instants are computed as so many. On processors with AVX-512, NumPy 1.24 multiplies complex
# arrays of less than 64 bytes in one of two ways that round differently, and chooses by how far the
# arrays lie from each other in memory: equal runs would end in different bits.
LEAST_INSTANTS = 4
# Change of an arm's stiffness by a motion's loads, from which results without it are not trusted.
STIFFNESS_CHANGE_LIMIT = 0.05

# -- ranks -----------------------------------------------------------------------------------

# Singular value over the largest, below which a direction counts for nothing: rounding leaves
# 1e-16; the least that counts was 0.4, of pins that hold flexible arms out of their plane.
RANK_SHARE = 1e-6
