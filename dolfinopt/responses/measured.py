"""Constants of the room that were chosen by measurement or trial, by the file that uses them.

Each stands with its unit, what it rules, and what was measured.
"""

# -- motions, and whether arms get geometric stiffness     ------------------------------------

COARSE_INSTANTS = 200  # of a motion, at which loads and stress are looked at first
# Of an arm's stiffness, by the loads of the motion, from which on "auto" takes it into account. The
# deviation changes by 0.1 to 2.5 times as much, under feed-forward by 10 to 20 times.
STIFFNESS_CHANGE = 2.5e-3

# -- order_selection -------------------------------------------------------------------------

RICHER_COORDINATES = 24  # least, of the motion that others are compared with; else twice theirs
COORDINATES_LIMIT = 64  # of an arm, tried at most, also for poles
TIME_ERROR_SHARE = 0.03  # of the tolerance, that time steps may add to a motion

# -- stress: p-mean and screening ------------------------------------------------------------

MAP_ERROR_SHARE = 1e-3  # of the largest length, a map's error; with 0 it takes three times as long
# Instants whose largest stress to the power p is below this part of the largest one's are left out
# of the p-mean. With all of them an iteration at 400 x 24 cells takes 1.3 times as long.
NEGLIGIBLE_POWER_SHARE = 1e-2
BLOCK_SIZE = 256  # points, and instants, of one block: it stays in the cache

# -- buckling: instants and modes ------------------------------------------------------------

BUCKLING_PEAKS = 3  # instants of an arm that count in the smooth value, at most
BUCKLING_MODES = 4  # of an instant: of several equal struts all
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

# -- poles -----------------------------------------------------------------------------------

# Of the p-norm of 1 - damping ratio: poles that are damped by 0.0025 more count e times less, and
# ten equal ones are taken for 0.006 less.
DAMPING_EXPONENT = 400.0
