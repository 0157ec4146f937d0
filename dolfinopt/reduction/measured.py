"""Constants of the room that were chosen by measurement or trial, by the files that use them.

Each stands with its unit, what it rules, and what was measured.
"""

# -- eigenproblem --------------------------------------------------------------------------------

# Relative gap of eigenvalues up to which there may be more of the same: with the tolerance
# above, vectors of values that close are known to 1e-6 of one another only.
EIGENVALUE_GAP = 1e-6
# Part of a nearby mode, in M, beyond which the modes that were found do not contain it. Relative
# residual with which from cold the next mode beyond is looked for: 8 solves, 18 to all digits.
LOST_MODE_SHARE = 1e-2
# Part of a ramp without symmetry in an initial space of old modes, in norm: from 1e-8 on the search
# finds modes of another symmetry, up to 1e-4 it is not slower.
RAMP_SHARE = 1e-6
# Steps of the search from nearby modes beyond four for each that is wanted: at designs of an
# optimisation 1 takes 8, 4 take 17, 12 take 50, 24 take 124. A search that takes more begins anew
# in SLEPc; with two for each, 12 and 24 did so in most iterations, and an iteration took a fifth
# more.
WARM_STEPS = 16

# -- basis, methods: Krylov subspaces, Gramians --------------------------------------------------

# Blocks of a Krylov space: for a shift up to 40 times the first frequency 5 to 10 are the rule.
KRYLOV_BLOCKS_LIMIT = 60
# Of a column's length: a remainder below adds nothing but rounding. Relative residual of responses
# in a band, in energy; directions whose response is below this part of the largest are lost in it.
DEFLATION_SHARE = 1e-10
# A second round leaves columns their length; what shrinks below this was rounding in the first.
ROUNDING_LENGTH_SHARE = 0.1
