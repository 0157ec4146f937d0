"""Constants of the room that were chosen by measurement, by what they rule.

Each stands with its unit and what was measured.
"""

# -- steps -----------------------------------------------------------------------------------

STEPS_PER_PERIOD = 8.0  # of the slowest vibration, on a first grid
FIRST_GRID_STEPS = 400  # at most: where eight a period are 9 000, a motion may need 90
USUAL_TOLERANCE = 2.8e-4  # that such steps with four stages meet: paper's example
# Of the tolerance, accepted: the estimate is 0.55 to 1 times the error; and aimed at: it varies by
# some ten percent from design to design, and a grid that is refined costs more than one too fine.
ACCEPTED_SHARE = 0.6
AIM = 0.4
# Growth of the number of steps: least, least where the last one did not help, and most.
FINER_GRID_RATIOS = (1.15, 2.5, 6.0)
NEIGHBOURS_RATIO = 3.0  # of the lengths of two steps in succession, at most
GRIDS_LIMIT = 12
STEPS_LIMIT = 30_000  # over the horizon
FINE_TOLERANCE = 1e-9  # below it a fifth stage pays: 1e-12 is met with five, not with four

# -- Newton's method -------------------------------------------------------------------------

# Angles w h, rad, up to which coordinates are slow, tried in turn: 6 iterations with 30 and 40, 10
# with 20, in an optimisation of the paper's example. The estimate takes the first: with 16 it was
# half of what it should be where undamped vibrations turn by 20 a step.
SLOW_ANGLES = (40.0, 120.0)
DENSE_COORDINATES = 32  # up to so many all are treated densely: 12 to 64 take as long, 10 %
MATRIX_BYTES = 300e6  # of the matrices of steps that are solved together, and of what is kept
KEPT_CONTRACTION = 0.3  # that keeps a matrix: half of it, or twice, take as long
SETTLED_SHARE = 1e-2  # step, of the tolerance, that no matrix shortens: rounding

# -- march -----------------------------------------------------------------------------------

MARCH_ERROR_SHARE = 0.1  # of the tolerance, that a step may add; with 0.3 one grid more follows
WINDOW_STEPS = (4, 32)  # solved together, fewest and most
LEAST_STEP_SHARE = 1e-7  # of the horizon: where shorter ones fail the motion has no continuation
# Deflection over a body's length beyond which its motion is refused. A cantilever that linear
# elasticity bends by 0.5 of its length bends by 0.41, and comes 0.11 closer, which a floating frame
# with linear elasticity leaves out (elastica under a load across its end; 0.1: 1 % and 0.006,
# 0.3: 9 % and 0.05, 1: 66 % and 0.25).
DEFLECTION_LIMIT = 0.5

# -- error estimate --------------------------------------------------------------------------

# Share of the largest group against which one that nearly rests beside the others is measured:
# rounding and Newton's leftover of the large ones is no error of the small one.
RESTING_GROUP_SHARE = 1e-3

# -- adjoint ---------------------------------------------------------------------------------

# Steps after which more coordinates are treated densely: of eight arms in space 10, and a matrix
# that is dense in all of their 48 coordinates costs as much as 50.
ADJOINT_CORRECTIONS_LIMIT = 20

# -- systems ---------------------------------------------------------------------------------

EQUILIBRIUM_ITERATIONS = 50  # of Newton's method at t = 0: 3 to 6, of machines 3 to 8, or it folds
# Compliance of closures, over the softest arm's, in directions that no joint which follows moves:
# 1e-6 moves the deviation of five_bar.toml by 2e-7, 1e-4 by 2e-5.
CLOSURE_COMPLIANCE_SHARE = 1e-6
# Relative errors and steps below it that do not fall are rounding; so are T'KT beside the identity
# and damping beside what is in proportion to the stiffness.
ROUNDING = 1e-9
EXACT = 1e-13  # what rounding leaves of a solution, beside its terms
FILE_ROUNDING = 1e-6  # relative, of limits in files, and of instants that are one

# -- build, trajectory -----------------------------------------------------------------------

RESPONSE_INTERVAL = 1e-3  # s, the longest from one instant of the responses to the next
RESPONSE_INSTANTS_LIMIT = 1_000_000  # at `RESPONSE_INTERVAL`: they take 1 GB and 3 s
# Of the largest elastic deflection, by which an extreme may exceed its neighbouring instants: the
# default simulation.tolerance.
EXTREME_EXCESS_SHARE = 1e-4
# Of a motion that is kept: an iteration asks for eight, with up to 3 000 instants each.
KEPT_INSTANTS_LIMIT = 20_000

# -- state_space -----------------------------------------------------------------------------

# Largest displacement, m or rad, along a vibration or the motion over which sixth-order differences
# are taken: what they leave out and rounding are both below 1e-10 of a first derivative.
POLE_STEP = 3e-3

# -- drives ----------------------------------------------------------------------------------

LINEAR_DRIVE_SHARE = 0.95  # of its limit, up to which a drive gives what is wanted of it

# -- feed_forward ----------------------------------------------------------------------------

SPLINE_DEGREE = 5  # four times continuously differentiable, as tables of joints
FINEST_KNOTS = 16.0  # times closer are knots beside breakpoints, where steps grow by
KNOT_GROWTH = 1.5  # a step over the one before, away from breakpoints
FIRST_SPACING = 0.02  # of the motion's duration
LEFT_AIM = 1e-4  # of the deviation without corrections
# The first leaves 4e-3 of it on two_arm, the second 1e-5. Joints in surplus share the work by twice
# as many: with two a slope is 1e-4 off.
GAUSS_NEWTON_STEPS = 2
# Of the normal matrix's trace: it leaves 1e-6 m of two_arm's 55 mm; with joints in surplus 4e-7 m,
# where the gradient of 1e-8 is 1e-4 off.
REGULARISATION = 1e-8
OF_REDUNDANT = 1e-6
# Of the deviation, with which left second derivatives count: with 3e-5 left (cart and second arm of
# two_arm) a slope is 6e-4 off without them, with 2e-5 (both arms) less than 1e-5.
CURVED_SHARE = 1e-5
CURVATURE_STEPS = 3
JOINT_DIFFERENCE = 1e-3  # rad, m, of the joints, by which these are differences
FORCE_INTERVAL = 1e-3  # s, between the known forces of a control
SINGULAR_TIP = 1e-3  # least singular value of the tip's Jacobian, over the reach
TIP_INSTANTS = 121  # at which it is looked at

# -- law -------------------------------------------------------------------------------------

LAW_DIFFERENCE = 1e-5  # of a variable's range: central differences err by 1e-9 of the derivative
