"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

# -- cells: assembly, tensors ----------------------------------------------------------------

# Largest difference of cells' matrices, or edges, from their mean, in its largest entry, that is
# rounding of the nodes' places: 1e-16 m in cells of 1 mm, and what Gmsh adds in a file's grid.
ALIKE_CELLS_ERROR = 1e-11
# Entries of the products of the modes' differences at a time: they stay in the cache; and the least
# cells at a time, for more modes.
STRESS_CHUNK_ENTRIES = 120_000
STRESS_CHUNK_CELLS = 256
# NumPy copies factors that it repeats along an axis into buffers, unless rows are longer than
# these: by default 8192, which takes longer than the products.
BUFFER_ENTRIES = 256
FIELD_CHUNK_ENTRIES = 4_000_000  # of nodal fields that are copied at a time: 32 MB
KERNEL_CHUNK_ENTRIES = 2_000_000  # cells, times cubes of their nodes, computed at a time: 100 MB

# -- interface -------------------------------------------------------------------------------

SAME_PLACE_SHARE = 1e-9  # of an arm's length: places no farther apart than this are one
# Largest relative error that rounding may make in the stiffness of a design in which solids float:
# a tenth of what an optimiser's step changes. Against long double errors are 0.03 to 0.35 of the
# estimate.
STIFFNESS_ROUNDING_LIMIT = 1e-3
# Part of a cell's displacement as a rigid translation in that estimate. The energy does not know
# translations, the assembled matrix does: where they are lost in it, refinement fails.
ROUNDING_TRANSLATION_SHARE = 0.03
ROUNDING_ITERATIONS = 6  # of that estimate; four give two digits
DEFLECTION_ROUNDING_ERROR = 1e-8  # of a deflection, by factors of long arms
# Ratio of Young's moduli up to which floating solids do no harm: the stiffness of an arm is then
# off by at most a few 1e-7, from rounding.
HARMLESS_CONTRAST = 1e6

# -- stress: directions of a motion's loads ----------------------------------------------------

# Of the largest one, by the length of the accelerations, below which a direction in which the loads
# vary along a motion is none. Stress of spatial_arm.toml is then right to 4e-12 of the largest, by
# 34 to 40 solves an arm in place of 54 or 66.
MOTION_RANK_SHARE = 1e-9
SUMS_RANK_SHARE = 1e-11  # the same of displacements whose adjoints are summed
# Part of the loads up to which so many directions are solved for in their place.
FEWER_DIRECTIONS = 0.9

# -- interior: the choice of a solver --------------------------------------------------------

# Rows times bandwidth squared up to which a band is factorised as such: an arm of 1600 x 96 cells
# has 1.2e10, and a nearby design takes 0.93 s, by MUMPS 1.1 to 1.4, by PETSc's Cholesky 1.6
# (docs/pages/develop/profile.md). The band takes 8 bytes times rows times bandwidth, 0.5 GB there.
BAND_WORK_LIMIT = 1.5e10
# Of a solid arm beside MUMPS: a slender one of 180 x 18 x 12 cells, 133 000 rows, has 7e10 and
# takes three quarters of its time; one of 220 x 22 x 14 cells has 2.4e11 and takes as long.
SOLID_BAND_WORK_LIMIT = 1.5e11
# Rows from which MUMPS takes less time than PETSc's Cholesky, in the plane on one rank, if a design
# takes 10 solves. Factorisation and 18 solves: 121 878 rows (1000 x 60 cells) 0.23 and 1.00 s by
# MUMPS, 0.78 and 0.42 s by PETSc; 205 242 rows 0.55 and 1.67 s, 1.48 and 0.69 s.
MUMPS_ROWS = 150_000
# Bandwidth beyond which a solid arm is solved by conjugate gradients: they take the same time a row
# whatever the shape, factors the longer the larger the cross-sections. With this one a nearby
# design takes equally long: slender arms of 250 000 and cubes of 22 000 rows by aggregates. By
# grids six constraint modes and their exact gradient take 2.75 s at 51 603 rows, bandwidth 1391,
# and 2.66 s by the band; 3.9 and 2.9 s at 132 645 rows, bandwidth 803.
WIDEST = 1200
# The same of boxes of which static loads are asked alone: one load by geometric multigrid takes as
# long as the band at 11 157 rows, bandwidth 221 (0.022 s), a third of it at 41 775 rows, bandwidth
# 395 (0.08 and 0.19 s), a sixth at 132 645 rows, bandwidth 803 (0.29 and 1.9 s).
WIDEST_OF_STATICS = 250
# Its tolerance by that of the scene, and the least: gradients are those of a factor to 1e-10.
STATICS_TOLERANCE_SHARE, LEAST_STATICS_TOLERANCE = 1e-3, 1e-11
# Quadratic tetrahedra, whose meshes are irregular, tell nothing by their bandwidth. Rows beyond
# which they are solved by conjugate gradients, and rows times bandwidth squared up to which a band
# is factorised. CPU seconds of a body for a nearby design, by MUMPS, conjugate gradients and the
# band: 9 678 rows of a slender link 0.06, 0.26, 0.08; 24 213 rows 0.19, 0.77, 0.35; 62 856 rows
# 0.71, 3.15, 2.53; cubes of 21 141 rows with geometric stiffness 0.52, 2.84; 94 902 rows 7.6, 18.4.
# Of cubes the first grow as rows to 1.55 and would meet at 500 000.
TETRAHEDRA_ROWS = 500_000
TETRAHEDRA_BAND_WORK_LIMIT = 1e9
# Conjugate gradients, too, where factors take more than this part of the memory that is free; no
# band where it takes more. Bytes a row of MUMPS' factor with so many rows, and the power of the
# rows with which they grow.
FREE_MEMORY_SHARE = 0.5
FACTOR_BYTES = 14e3
FACTOR_ROWS = 50_000
FACTOR_EXPONENT = 0.12
# Bandwidth of K with the interfaces' rows behind, of that without, up to which it is factorised in
# its place: nodes numbered along the arm end at the interface, others may lie anywhere.
EXTENDED_BANDWIDTH_RATIO = 1.05

# -- interior, multigrid: conjugate gradients ------------------------------------------------

# Relative, in energy, where nobody says what is needed: stiffness is then right to its square, mass
# and inertia to it, gradients of frozen loads to five times it, geometric stiffness to ten times.
ENERGY_TOLERANCE = 1e-8
KRYLOV_TOLERANCE = 1e-12  # the same where a Krylov space is made of solutions
# Smoother: Chebyshev's polynomial of degree 2 in the diagonally scaled matrix on this part of its
# spectrum, of the largest eigenvalue from so many steps of Lanczos' method, with a margin.
SMOOTHED_LOWER_SHARE = 0.1
SMOOTHED_UPPER_SHARE = 1.1
LANCZOS_ITERATIONS = 10
ZERO_DIAGONAL_SHARE = 1e-15  # of the largest diagonal entry
# Boxes: nodal values of so many cells, times right sides, at a time stay in the cache.
BOX_CHUNK_COLUMNS = 4096
# Ratio of a cell's edges to the shortest that can be joined up to which they are joined, too.
COARSENED_EDGE_RATIO = 2.0
COARSEST_BAND_WORK = 3e8  # rows times bandwidth squared up to which a grid is the coarsest
RIGHT_SIDES_CHUNK = 12  # right sides at a time: memory of their vectors on all levels
SOLVER_ITERATIONS = 500
# The hierarchy of another design is kept while it takes at most so many times the steps a digit.
KEPT_HIERARCHY_RATIO = 1.5
# Steps a digit from cold beyond which a hierarchy of smaller aggregates is made: it takes half of
# the steps, each as long again, and three times the work to make it.
STEPS_A_DIGIT_LIMIT = 12.0
SOLUTION_ROUNDING_ERROR = 1e-12  # least tolerance, of the right side's own length
INDEPENDENT_LENGTH_SHARE = 1e-12  # least part of a direction's length that is none of the others'
