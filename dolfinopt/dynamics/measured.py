"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

import numpy as np

# -- several files ---------------------------------------------------------------------------

# Share of the largest group against which one that nearly rests beside the others is measured:
# rounding and Newton's leftover of the large ones is no error of the small one.
RESTING_GROUP_SHARE = 1e-3
EQUILIBRIUM_ITERATIONS = 50  # of Newton's method at t = 0: 3 to 6, of machines 3 to 8, or it folds
KEPT_MATRICES_BYTES = 64e6  # of what is kept for further functions of the same trajectory

# -- collocation: time grids and instants ----------------------------------------------------

STEPS_PER_PERIOD = 8.0  # of the slowest vibration, on a first grid
FIRST_GRID_STEPS_LIMIT = 20_000  # more are asked for by estimated errors alone
# Even steps that are tried for what the loads of stiff arms need, the ratio from one number to the
# next, and the share of eight steps a period that they may be at first: fewer gain too little.
FEWEST_STEPS = 20
FOLLOWED_STEPS_RATIO = 1.5
FOLLOWED_STEPS_SHARE = 0.25
# Error over the tolerance up to which more steps are tried: their growth, and where the error
# stays, as of vibrations, at once the most of them, as a share of eight a period.
FEW_STEPS_ERROR_RATIO = 100.0
FEW_STEPS_GROWTH = 2
MOST_FEW_STEPS_SHARE = 0.4
# Of the tolerance, accepted of them: the estimate is 0.23 to 1.7 times the error, as what tables
# excite between the breakpoints is not seen.
FEW_STEPS_ESTIMATE_SHARE = 0.25
RESPONSE_INTERVAL = 1e-3  # s, the longest from one instant of the responses to the next
RESPONSE_INSTANTS_LIMIT = 1_000_000  # at `RESPONSE_INTERVAL`: they take 1 GB and 3 s
LONG_MOTION_INSTANTS = 100_000  # of a motion beyond that limit, unless it bends faster
# Of the largest elastic deflection, by which an extreme may exceed its neighbouring instants: the
# default simulation.tolerance.
EXTREME_EXCESS_SHARE = 1e-4
EVEN_STEPS_ROUNDING = 1e-9  # difference of even steps, over the time between breakpoints

# -- collocation: vibrations that the steps do not resolve -----------------------------------

COMPARED_STEP_COUNTS = 16  # numbers of steps, about, after which a free vibration is compared
VIBRATION_ROUNDING_ERROR = 1e-14  # of the stability function R, growing with the steps

# -- elastic_system, machine_system ----------------------------------------------------------

# Contraction that keeps the stiffness found at first: of spatial_arm.toml it is 1e-5.
EQUILIBRIUM_KEPT_CONTRACTION = 1e-3
EQUILIBRIUM_ROUNDING_ERROR = 1e-14  # relative step at t = 0 below which nothing changes
MACHINE_EQUILIBRIUM_ROUNDING_ERROR = 1e-13  # the same of machines, beside the coordinates
# A relative step below it that is not half of the one before is rounding of an ill-conditioned
# stiffness.
EQUILIBRIUM_STALLED_ERROR = 1e-8
IDENTITY_ROUNDING_ERROR = 1e-9  # of T'KT that is still taken for the identity
PROPORTION_ROUNDING_ERROR = 1e-12  # relative, of integrals that are a factor times others
MEAN_MASS_INSTANTS = 3  # whose mass is averaged: 1 to 9 cost the same iterations

# -- newton ----------------------------------------------------------------------------------

BLOCKS_BYTES = 64e6  # of blocks inverted together: bounds the memory with many coordinates
FACTORS_BYTES = 256e6  # of the factors of steps that are solved together
# Angles w h, rad, up to which coordinates are slow, tried in turn: 6 Newton iterations with 30 and
# 40, 10 with 20, in an optimisation of the paper's example.
SLOW_ANGLES = (40.0, 120.0, np.inf)
# Slowest coordinates with dense blocks as long as not all must be: on short steps nearly all would.
DENSE_COORDINATES_LIMIT = 24
# The same of matrices whose tangent is held over a step, which cost a tenth.
HELD_COORDINATES_LIMIT = 48
EXACT_COORDINATES_LIMIT = 12  # up to so many the exact matrix costs less than more iterations
# Of the tolerance, that Newton's method may leave when the error is estimated: where that is above
# the tolerance, the steps are refined at once. What is left moves the estimate by less than 1e-3.
NEWTON_ROUGH_SHARE = 1e-4
NEWTON_ROUNDING_ERROR = 1e-9  # relative steps and errors below it that do not fall are rounding
# Step below which a poor contraction is blamed on the matrix, no more on the nonlinearity.
NEWTON_SETTLED_STEP = 0.01
INVERTED_MATRICES_CHUNK = 512  # matrices at a time: they stay in the processor's cache
# Coordinates up to which complex matrices are inverted by a sweep over all steps, beyond one by one
# in LAPACK: of 8 coordinates 1.4 to 1.8 microseconds a matrix either way, of 24 30 and 12, of 48
# 250 and 59.
SWEPT_COORDINATES_LIMIT = 8

# -- radau: grids ----------------------------------------------------------------------------

RADAU_GRIDS_LIMIT = 12  # each at least 1.1 times finer
RADAU_STEPS_LIMIT = 30_000  # of a grid; fewer where they take more than so many bytes
RADAU_BYTES_LIMIT = 3e9
# An error above this is no estimate: of a grid that Newton's method has solved in windows, or so
# many times that of a coarser one, it tells that the steps find another motion than finer ones
# would. Of steps merely too long errors are below 1.
LOST_MOTION_ERROR = 0.5
LOST_MOTION_ERROR_RATIO = 1e3
# Grids in turn whose error is above this part of the one before until a motion is given up: as long
# as a vibration is not resolved its error does not fall.
STALLED_GRIDS_LIMIT = 4
STALLED_ERROR_RATIO = 0.9
# Least growth of the steps at the first refinement, and at most at later ones, where the order that
# is seen decides: as long as vibrations are not resolved the error falls more slowly.
FIRST_REFINEMENT_RATIO = 1.1
LATER_REFINEMENT_RATIO = 2.0
# Order that the first refinement counts on with more than `DENSE_COORDINATES_LIMIT` slow
# coordinates, whose grids cost most: chains of 5 to 8 arms show 4.1 to 5.0 with four stages.
FIRST_REFINEMENT_ORDER = 4.4
# Newton iterations times time steps, of all grids: 50 to 190 microseconds each with 8 to 20
# coordinates; and of long motions so many iterations of their first grid.
RADAU_WORK_LIMIT = 100_000
FIRST_GRID_ITERATIONS_LIMIT = 100
FINER_GRID_ITERATIONS = 8  # the usual number on a finer grid
RADAU_ESTIMATE_SHARE = 0.6  # of the tolerance, accepted: the estimate is 0.55 to 1 times the error
# Of the tolerance, aimed at by a new grid: the estimate varies by some ten percent between
# neighbouring designs, and a grid that is refined twice costs more than one too fine.
RADAU_AIM_SHARE = 0.4
# Error with `STEPS_PER_PERIOD`, by stages: paper's example, initial design. The first grid is
# chosen by it up to this growth of the steps; else it is coarse.
FIRST_GRID_ERROR = {1: np.inf, 2: 0.083, 3: 4.6e-3, 4: 1.1e-4, 5: 7e-6}
FIRST_GRID_GROWTH_LIMIT = 1.6

# -- radau: estimated error ------------------------------------------------------------------

# Correction of an estimate, of itself, that still lets it be believed: the next is a fifth.
ESTIMATE_CORRECTION_SHARE = 0.2
ESTIMATE_CORRECTIONS_LIMIT = 4  # mostly one
# Contraction of Newton's iteration up to which one answer, with what it may leave, estimates the
# error; beyond it is corrected, which takes an eighth of the time of all.
ESTIMATE_CONTRACTION_LIMIT = 0.2

# -- radau: windows and marching -------------------------------------------------------------

# Deflection over a body's length beyond which its motion is refused. A cantilever that linear
# elasticity bends by 0.5 of its length bends by 0.41, and comes 0.11 closer, which a floating frame
# with linear elasticity leaves out (elastica under a load across its end; 0.1: 1 % and 0.006,
# 0.3: 9 % and 0.05, 1: 66 % and 0.25).
DEFLECTION_LIMIT = 0.5
# Steps solved together where nothing is known of free coordinates: two turns of a slider-crank take
# 16 iterations, with 16 steps 44, all at once 117.
UNKNOWN_MOTION_STEPS = 2
WINDOWS_ITERATIONS_LIMIT = 60  # of a grid, on average over its steps: windows take 10 to 50
# Steps of a window: fewer where Newton's method fails or steps get shorter, more where all is well.
SHORTEST_WINDOW_STEPS = 4
LONGEST_WINDOW_STEPS = 32
WINDOW_MATRICES_LIMIT = 6  # of Newton's method: shorter steps take less than more of them
# Of the steps after a failure: each attempt costs a window, too short ones the whole rest.
FAILED_STEP_RATIO = 0.5
STEP_GROWTH_LIMIT = 2.0  # from one window to the next
LEAST_STEP_SHARE = 1e-7  # of the horizon: where shorter ones fail the motion has no continuation
MARCH_STEPS_LIMIT = 20_000
MARCH_ITERATIONS_LIMIT = 2_500  # of Newton's method, of all windows: 2 to 6 ms each
# Bounds of a step's angle w h, rad: w is the frequency of a vibration as large as the whole motion
# that has the accelerations' highest derivative. Of even steps it is 2 pi / `STEPS_PER_PERIOD`.
MARCH_ANGLE_BOUNDS = (0.05, 1.0)
MARCH_ANGLE_EXCESS = 1.5  # times the angle aimed at, still accepted

# -- batch -----------------------------------------------------------------------------------

BATCH_GRIDS_LIMIT = 4  # refinements until a system is left to `radau.integrate`
PILOTS_LIMIT = 3  # systems that are tried for a first, rough solution
# What Newton may leave, about, over the tolerance: of values, and of a first, rough solution.
BATCH_NEWTON_SHARE = 1e-3
PILOT_NEWTON_SHARE = 0.1
# Steps grow with the speed of the slowest vibration to this power: lighter payloads vibrate faster,
# and less. Paper's example, 4 kg against 6 kg: 0.4 initial, 0.6 optimised.
SPEED_EXPONENT = 0.5
BATCH_SIZE_LIMIT = 40_000  # steps times coordinates: with more, arrays leave the processor's cache

# -- generalized_alpha -----------------------------------------------------------------------

ALPHA_STEPS_LIMIT = 400_000
ALPHA_NEWTON_ITERATIONS = 12  # of a step, mostly one
ALPHA_FAILURES_LIMIT = 3  # of Newton's method, on grids each four times finer than the one before
ALPHA_CONTRACTION_LIMIT = 0.03  # of an iteration, above which the tangent is renewed
# Residual left in a step, as static deflection, in units of tolerance times the largest one: a
# thousandth leaves room for resonance.
ALPHA_RESIDUAL_SHARE = 1e-3
ALPHA_ROUNDING_ERROR = 1e-12  # least residual asked for: cancellation between stiff coordinates
ALPHA_ESTIMATE_SHARE = 0.8  # of the tolerance, accepted: the estimate is good to some percent
ALPHA_AIM_SHARE = 0.6  # of the tolerance, aimed at by a new grid

# -- adjoint ---------------------------------------------------------------------------------

# Of the multipliers, that a correction may have left: their error is a tenth of it or less.
ADJOINT_CORRECTION_SHARE = 1e-9
# Steps after which more coordinates are treated densely: of eight arms in space 10, and a matrix
# that is dense in all of their 48 coordinates costs as much as 50.
ADJOINT_CORRECTIONS_LIMIT = 20

# -- build, simulation -----------------------------------------------------------------------

TABLE_BREAKPOINTS_LIMIT = 50  # rows of a table of forces that begin steps: more are a curve
# Desired motions kept, and instants of one: an iteration asks for eight, with up to 3 000 instants.
MOTIONS_KEPT = 16
KEPT_INSTANTS_LIMIT = 20_000
SAME_INSTANT_SHARE = 1e-6  # of the horizon, within which two instants are one
JOINT_LIMIT_ROUNDING = 1e-6  # relative, of a joint's limit, which files round
DRIVES_CHUNK = 512  # instants whose matrices are made at once for the drives' derivatives

# -- state_space -----------------------------------------------------------------------------

# Largest displacement, m or rad, along a vibration or the motion over which sixth-order differences
# are taken: what they leave out and rounding are both below 1e-10 of a first derivative.
POLE_STEP = 3e-3
