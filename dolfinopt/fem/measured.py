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
# Cells, times cubes of their nodes, whose matrices are computed at a time: 2 MB; with 40 MB a mesh
# of 17 280 hexahedra takes 5 % longer.
KERNEL_CHUNK_ENTRIES = 100_000

# -- shape_derivative ------------------------------------------------------------------------

# Cells at a time. A row of stress of a rod with 1 800 triangles takes 0.20 s with 128 and 256, 0.17
# with 512 and 1024, and 0.23 with 27 of K0.
DERIVATIVE_CHUNK_CELLS = 512

# -- interface -------------------------------------------------------------------------------

# Largest bound of the relative error that rounding makes in the stiffness of a soft design. The
# error itself is up to 1e-3 then with DOLFINx 0.5, a tenth of what an optimiser's step changes, and
# up to 4e-3 with 0.9.
ROUNDING_ERROR_LIMIT = 0.4
# Ratio of Young's moduli up to which floating solids do no harm: the stiffness of an arm is then
# off by at most 1e-6, from rounding.
HARMLESS_CONTRAST = 1e7

# -- interior: the choice of a solver --------------------------------------------------------

# Rows times bandwidth squared up to which a band is factorised as such: an arm of 1600 x 96 cells
# has 1.2e10, and a nearby design takes 0.93 s, by MUMPS 1.1 to 1.4, by PETSc's Cholesky 1.6
# (docs/pages/develop/profile.md). The band takes 8 bytes times rows times bandwidth, 0.5 GB there.
BAND_WORK_LIMIT = 1.5e10
# Of a solid arm beside MUMPS: a slender one of 180 x 18 x 12 cells, 133 000 rows, has 7e10 and
# takes three quarters of its time; one of 220 x 22 x 14 cells has 2.4e11 and takes as long.
SOLID_BAND_WORK_LIMIT = 1.5e11
# Bandwidth beyond which a box is solved by conjugate gradients with multigrid: they take the same
# time a row whatever the shape, factors the longer the larger the cross-sections. Six constraint
# modes and their exact gradient take 2.75 s at 51 603 rows, bandwidth 1391, and 2.66 s by the band;
# 3.9 and 2.9 s at 132 645 rows, bandwidth 803.
WIDEST = 1200
# The same of boxes of which static loads are asked alone: one load by geometric multigrid takes as
# long as the band at 11 157 rows, bandwidth 221 (0.022 s), a third of it at 41 775 rows, bandwidth
# 395 (0.08 and 0.19 s), a sixth at 132 645 rows, bandwidth 803 (0.29 and 1.9 s).
WIDEST_OF_STATICS = 250
# Their tolerance, in energy, relative, unless the scene's is less: gradients are a factor's then.
STATICS_TOLERANCE = 1e-10
# Rows times bandwidth squared up to which a band of triangles or tetrahedra is factorised, whose
# meshes are irregular. Milliseconds of a new mesh's factor, of the next one, and of eleven right
# sides, by MUMPS and the band: 7 928 rows of a plane part, 2.5e8: 35, 38; 9, 12; 5, 6; 20 020 rows,
# 1.8e9: 105, 107; 20, 63; 10, 75; and of a solid link's body, 24 213 rows: 190, 350 in all.
SIMPLICES_BAND_WORK_LIMIT = 2e8
# Bytes of MUMPS' factor of a solid: so many times the rows to this power, 0.7 GB of 50 000 rows.
FACTOR_BYTES, FACTOR_EXPONENT = 3.8e3, 1.12

# -- conjugate gradients: multigrid, adjoints of modes ----------------------------------------

# Relative, in energy, where nobody says what is needed: stiffness is then right to its square, mass
# and inertia to it, gradients of frozen loads to five times it, geometric stiffness to ten times.
# Deflections of long arms by a factor have no more digits, either. Modes without a factor and the
# adjoints of modes are found to it, too: more than an optimiser can use.
ENERGY_TOLERANCE = 1e-8
# Part of the diagonally scaled matrix' spectrum, up to its end, that is smoothed: 23 steps for a
# slender box beam of 73 599 rows, with 0.09 24, with 0.15 26.
SMOOTHED_SHARE = 0.05
# Boxes: nodal values of so many cells, times right sides, at a time stay in the cache.
BOX_CHUNK_COLUMNS = 4096
COARSEST_BAND_WORK = 3e8  # rows times bandwidth squared up to which a grid is the coarsest
SOLVER_ITERATIONS = 500
# Least tolerance, of the right side's own length; and least part of a direction's length or energy
# that is none of the others': dependent ones leave 1e-16, independent ones have 1e-2. Relative
# residual of eigenpairs and of what is to be right to nearly all digits: vectors are then right to
# about 1e-10, which keeps designs equal to 1e-8 on any number of ranks; each further digit costs a
# fraction of a step. Two rounds of Gram and Schmidt leave 1e-15 to 1e-14.
ROUNDING_SHARE = 1e-12
