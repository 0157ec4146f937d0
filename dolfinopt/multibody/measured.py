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

# -- motion ----------------------------------------------------------------------------------

# Nearer to a singular position than this part of the largest arm, joint speeds lose their digits:
# accelerations grow with the inverse cube of sin(elbow angle).
SINGULAR_DISTANCE_SHARE = 1e-6
DEAD_CENTRE_SHARE = 1e-6  # of an arm's length: nearer to a dead centre rates lose their digits
# Of the whole motion, at which its reach is checked and its angles are told apart.
DENSE_INSTANTS = 2001
# With more rows a table's corners are many and small; the integrator's steps need not end there.
TABLE_CORNERS_LIMIT = 20

# -- spatial: joints that follow an end-effector ---------------------------------------------

REACHED_RESIDUAL_SHARE = 1e-11  # of the reach, that rounding leaves
FOLLOWED_RESIDUAL_SHARE = 1e-9  # of the reach, above which a pose is not reached
# Singular values of the Jacobian, rotations times the reach, over the largest: below it the joints'
# rates lose their digits.
SINGULAR_VALUE_RATIO = 1e-6
# Least steps of the dense table, and a row of the path's; cut where Newton's method needs it.
FOLLOWING_STEPS = 50
FOLLOWING_STEPS_A_ROW = 2
LEAST_FOLLOWING_SHARE = 1e-7  # of the duration: a shorter step has no continuation
JOINT_STEP_LIMIT = 0.3  # rad, or of the reach: a longer Newton step may lead to another solution
JOINT_NEWTON_ITERATIONS = 3  # from the dense table, right to 1e-5: the last one leaves rounding
DAMPED_ITERATIONS = 200  # at the start
STALLED_GAIN = 1e-9  # part by which the distance falls in one of them, below which it is the least
START_GUESSES = 10  # the first as stated, the others around it at random
KEPT_INSTANT_SETS = 16  # whose joints are kept: the integrator asks for the same ones again

# -- closures --------------------------------------------------------------------------------

# Singular values of the closures' Jacobian, columns of like size, over the largest: below it
# equations follow from others. Rounding leaves 1e-16; the least that counts was 0.4, of pins that
# hold flexible arms out of their plane.
INDEPENDENT_SHARE = 1e-6
