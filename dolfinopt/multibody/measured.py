"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

# -- dimension: series of a rotation ---------------------------------------------------------

# Terms up to an angle squared, rad^2, beyond which sine and cosine leave 1e-15 as well: they leave
# 1e-24 there. Interfaces turn by less.
SERIES_TERMS = 10
SERIES_LIMIT = 1.0

# -- loads ----------------------------------------------------------------------------------

# Change of an arm's stiffness by a motion's loads, from which results without it are not trusted.
STIFFNESS_CHANGE_LIMIT = 0.05

# -- ranks -----------------------------------------------------------------------------------

# Singular value over the largest, below which a direction counts for nothing: rounding leaves
# 1e-16; the least that counts was 0.4, of pins that hold flexible arms out of their plane.
RANK_SHARE = 1e-6
