"""Constants of the room that were chosen by measurement or trial.

Each stands with its unit, what it rules, and what was measured.
"""

# -- standard_input --------------------------------------------------------------------------

# How far matrices that must be symmetric, or zero, may be from it, relative to their largest
# entry, and places to a length: finite elements leave 1e-12, files with six digits 1e-6.
FILE_ROUNDING_SHARE = 1e-6
# How far the centrifugal matrix may be from that of the mass, relative to Me: lumped masses reach
# 5 %, geometric stiffening by rotation changes the sign of its diagonal for slender bodies.
CENTRIFUGAL_EXCESS_SHARE = 0.1
SAME_NODE_SHARE = 1e-9  # of an arm's extent: nodes of two ranks that are no farther apart are one
