"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

# -- eigenproblem: the modes' derivatives ----------------------------------------------------

# Relative residual of the modes' adjoints, in the energy of K^-1; gradients are then right to it,
# which leaves more digits than an optimiser can use.
ADJOINT_TOLERANCE = 1e-8
ADJOINT_ITERATIONS = 500  # of conjugate gradients for one mode

# -- eigenproblem: modes where no factor is at hand ------------------------------------------

GUARD_VECTORS = 3  # beyond those that are wanted: the last ones converge slowly
LOBPCG_ITERATIONS = 200
LOBPCG_TOLERANCE = 1e-8  # of the vectors in energy
# Part of a direction's length, squared, below which it is the others'.
LOBPCG_INDEPENDENT_SHARE = 1e-12

# Relative, in energy, of iterative solutions of which a Krylov space is made.
INVERSE_TOLERANCE = 1e-12

# -- eigenproblem: modes by a factor ---------------------------------------------------------

# Relative residual of the eigenpairs. Vectors are then right to about 1e-10, which keeps designs
# equal to 1e-8 on any number of ranks; each further digit costs a fraction of a step.
EIGEN_TOLERANCE = 1e-12
# Relative gap of eigenvalues up to which there may be more of the same: with the tolerance
# above, vectors of values that close are known to 1e-6 of one another only.
EIGENVALUE_GAP = 1e-6
# Part of a nearby mode, in M, beyond which the modes that were found do not contain it.
LOST_MODE_SHARE = 1e-2
# Part of a ramp without symmetry in an initial space of old modes, in norm: from 1e-8 on the search
# finds modes of another symmetry, up to 1e-4 it is not slower.
RAMP_SHARE = 1e-6
# Steps of the search from nearby modes beyond four for each that is wanted: at designs of an
# optimisation 1 takes 8, 4 take 17, 12 take 50, 24 take 124. A search that takes more begins anew
# in SLEPc; with two for each, 12 and 24 did so in most iterations, and an iteration took a fifth
# more.
WARM_STEPS = 16

# -- methods: Krylov subspaces, Gramians -----------------------------------------------------

# Blocks of a Krylov space: for a shift up to 40 times the first frequency 5 to 10 are the rule.
KRYLOV_BLOCKS_LIMIT = 60
# Relative residual of solutions at a shift, in the norm of M after multiplication by K^-1.
SHIFT_TOLERANCE = 1e-12
# Relative residual of the responses in the band, after multiplication by K^-1, in energy.
RESPONSE_TOLERANCE = 1e-10
# Directions whose response is below this part of the largest are lost in that.
RESPONSE_RANK_SHARE = 1e-10
# Part of the length of a vector of their Krylov space, below which its remainder is rounding.
RESPONSE_DEFLATION_SHARE = 1e-12

# -- basis -----------------------------------------------------------------------------------

DEFLATION_SHARE = 1e-10  # of a column's length: a remainder below adds nothing but rounding
# A second round leaves columns their length; what shrinks below this was rounding in the first.
ROUNDING_LENGTH_SHARE = 0.1
ORTHONORMALITY_ERROR = 1e-12  # largest entry of V' M V - I: two rounds leave 1e-15 to 1e-14
ORTHONORMAL_ROUNDS_LIMIT = 4  # two are the rule
# Least eigenvalue of the vectors' energies, scaled to one each, by the largest: rounding leaves
# 1e-16 of dependent vectors, independent ones have 1e-2. Whether Cholesky's method notices depends
# on the sign of that rounding.
INDEPENDENT_ENERGY_RATIO = 1e-12
