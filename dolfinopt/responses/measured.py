"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

# -- evaluation: whether the arms get geometric stiffness ------------------------------------

STIFFENING_INSTANTS = 201  # of the horizon, at which loads are looked at
# Of the largest deviation, that "auto" may leave out: 0.5 %, less what the static modes do not show
# of it (measured: a tenth).
NEGLECTED_DEVIATION_SHARE = 4e-3
# Largest change of an arm's stiffness with which it is left out, and that with which it is taken
# into account, without a simulation. Measured: the deviation changes by 0.3 to 3 times as much.
STIFFENING_OFF_CHANGE = 5e-4
STIFFENING_ON_CHANGE = 0.05

# -- order_selection -------------------------------------------------------------------------

# The motion is compared with one of at least so many coordinates, and so many times those tried.
RICHER_COORDINATES = 24
RICHER_RATIO = 2
TRIED_COORDINATES_LIMIT = 48  # of an arm
TIME_ERROR_SHARE = 0.03  # of the tolerance, that time steps may add to a motion

# -- stress: p-mean and screening ------------------------------------------------------------

MAP_ERROR_SHARE = 1e-3  # of the largest length, a map's error; with 0 it takes three times as long
# Instants whose largest stress to the power p is below this part of the largest one's are left out
# of the p-mean. With all of them an iteration at 400 x 24 cells takes 1.3 times as long.
NEGLIGIBLE_POWER_SHARE = 1e-2
# At most, at which all points are looked at first; every second one makes up the p-mean.
COARSE_INSTANTS = 200
BOUND_BATCH_INSTANTS = 16  # looked at before the bound is compared again
BLOCK_SIZE = 256  # points, and instants, of one block: it stays in the cache

# -- buckling: instants and modes ------------------------------------------------------------

BUCKLING_PEAKS = 3  # instants of an arm that count in the smooth value, at most
BUCKLING_PROMINENCE = 0.1  # of the largest value, by which peaks over time stand out
BUCKLING_MODES = 4  # of an instant: of several equal struts all
BUCKLING_RANK_SHARE = 1e-8  # of energies, below which modes of several instants are the same
# Part of solid stiffness at which the stress of a cell stiffens half as much as it would: so light
# a cell, x = 0.1 with the default law, buckles with a strut beside it, not by itself. Of a gap that
# closes, void buckles by itself at 2.6 times the load, with x = 0.01 in it at 4.3 times; with this
# share solid does, at 555 and 423 times. A strut of x = 0.5 loses 1 % of its stress.
VOID_STRESS_SHARE = 1e-3
LARGEST_FACTOR = 1e3  # above, nothing buckles: it tells nothing of a machine

# -- linearised_machine ----------------------------------------------------------------------

# Of a pole, over its size, that an exported machine may have. Poles that differ by half of it from
# those with twice as many coordinates hold it, in all demos, against four to sixteen times as many.
POLE_ERROR = 0.01
POLE_COORDINATES_LIMIT = 100  # of an arm: two in the plane take 14 s for all tries

# -- poles -----------------------------------------------------------------------------------

# Of the p-norm of 1 - damping ratio: poles that are damped by 0.0025 more count e times less, and
# ten equal ones are taken for 0.006 less.
DAMPING_EXPONENT = 400.0
