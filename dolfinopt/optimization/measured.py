"""Constants of the optimiser that were chosen by measurement or trial, a table.

Each with its unit and what it rules; problems as in `dolfinopt bench optimiser`.
"""


# -- The step (iterate); figures of the sixteen problems in docs: theory/optimiser --

# On the move limit where the merit rose; twice on a step without a motion or that leaps.
SHORTER_REACH = 0.5
REACH_GROWTH = 1.2  # on it where it did not
LEAST_REACH = 0.05  # of the scene's move limit
# Of design variables after a step: what floating-point arithmetic makes of it on one processor and
# another, up to 1e-10, is forgotten and does not grow. Of 4 800 variables in 75 iterations 0.07
# are rounded to another number, with six decimals 0.7; four leave out small moves.
DECIMALS = 5
# How much the newest design counts in the scales of limits (Le et al. 2010), 1 without a memory:
# with that the lightest arms for a stress end 0.7 % heavier, see docs: theory/optimiser.
LIMITS_MEMORY = 0.3
STEP_ATTEMPTS = 4  # the last one 1/64 as long
# For each time step of the last motion, and each of robust designs, before a design is given up;
# most take 3 to 10, machines 16 to 44, what falls apart thousands.
NEWTON_ITERATIONS = 100.0

# -- The projection, and the price of limits (problem) --

# Final beta up to which steps are as long as `optimizer.move` allows. With 64 two arms fall apart
# without shorter ones from a beta of 4 on.
GENTLE = 16.0
# Iterations in which beta doubles with which steps may get as short as `LEAST_REACH` meanwhile: the
# merit rises then by itself, and makes them so. Within 8 iterations and with that length a design
# falls apart, ten times as soft as with five times the length; it is five times as soft with three.
SLOW_CONTINUATION = 25.0
# Of a relative excess, in objectives: 1 % costs a tenth; mass and compliance change by 1 to 3 %
# with a percent of a limit.
LIMIT_PRICE = 10.0

# Times the nominal design's limits: what the eroded one keeps at most. Without it that of
# lightest_two_arm.toml falls apart after 97 iterations; with 4, 2 and 1.3 it ends at 1.199, 1.229
# and 1.257 kg, cut at one half 13.8, 8.4 and 8.06 mm from its path, of 8 allowed, with 38 and 4
# contacts in corners alone at 2 and 1.3.
ERODED_LIMIT_FACTOR = 1.3

# -- Residual and endings (stopping, loop) --

ROOM_SHARE = 1e-3  # of their range that variables are away from both bounds that can move
# Of the range, step of the variable that moves most: what bounds nearer than that hold.
TRIAL_STEP_SHARE = 0.1
WINDOW = 20  # iterations in which a run that goes on gains `optimizer.tolerance`; 10 end rods early
# Of the best design in half a window, with which frozen loads go on; with less the exact gradient.
FROZEN_GAIN = 0.01
# Of a limit: nearer than that it counts as reached; beta waits for a design that is farther beyond.
REACHED_LIMIT_SHARE = 0.02
# After which a checkpoint is written: a kill costs no more, writing stays below a percent.
CHECKPOINT_SECONDS = 2.0

# -- What is known of a finished design (certificate) --

# On the accuracy of coordinates chosen for the initial design; those of an optimised one err 1.7 to
# 2.7 times as much (3 to 8 coordinates, 48 x 6 cells).
COORDINATE_RESERVE_FACTOR = 3.0

# -- Taylor tests (gradient_check) --

INSIDE_MARGIN = 0.05  # design variables are moved so far inside [0, 1]: steps must not leave it
ROUNDING_SHARE = 1e-10  # of the objective, that Newton's tolerance leaves open
PASSING_RATE = 1.9  # least; 2 is exact, a wrong gradient has 1

# -- Approximation and its dual (mma); what is Svanberg's stands there --

# Of the range of a variable. With Svanberg's 0.5 rounding grows to 7e-5 of the objective of
# two_arm.toml in 90 iterations, with 0.2 to 1e-10, and to 5e-6 where distances grow by 1.4.
FIRST_ASYMPTOTE_DISTANCE = 0.2
# Of it, largest with curved constraints: with Svanberg's 10 limits of the motion are left every 25
# steps.
CURVED_ASYMPTOTE_DISTANCE = 1.0
DUAL_EVALUATIONS = 300  # at most; 4 to 5 are the rule
ROUNDING = 1e-14  # of sums relative to their terms
