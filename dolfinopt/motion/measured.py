"""Constants of the room that were chosen by measurement or trial; shares are of the reach."""

# -- plane -----------------------------------------------------------------------------------

# Nearer to a singular position than this part of the largest arm, joint speeds lose their digits:
# accelerations grow with the inverse cube of sin(elbow angle).
SINGULAR_DISTANCE_SHARE = 1e-6
# Of the whole motion, at which its reach is checked and its angles are told apart; and at which the
# way of what is prescribed is measured.
DENSE_INSTANTS = 2001

# -- build -----------------------------------------------------------------------------------

# With more rows a table's corners are many and small; the integrator's steps need not end there.
TABLE_CORNERS_LIMIT = 20

# -- constraints, start ----------------------------------------------------------------------

REACHED_SHARE = 1e-9  # above which a pose is not reached; Newton's method leaves 1e-15
STARTS = 10  # around the guess from which the start is looked for
# By which links that are held more often than needed may leave a loop open: it is told.
FITS_SHARE = 1e-4
# Times the misfit of such links: singular values, and gaps along the motion, that it makes.
MISFIT_FACTOR = 30.0

# -- singular --------------------------------------------------------------------------------

# Smallest singular value over that of usual poses, below which a pose is singular: a start at a
# dead centre is a double root, which closing to 1e-12 tells to 1e-6 at best. Coordinates are named
# whose entry of a null vector is larger.
SINGULAR_SHARE = 1e-3

# -- follower --------------------------------------------------------------------------------

SAMPLES = 12  # of a motion at least, and more for each turn of what is prescribed
TURNS_LIMIT = 1000  # of what is prescribed, which takes 15 s to follow
