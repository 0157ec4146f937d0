"""What exists in space alone. Plane machines need none of it.

`mechanism` (trees of bodies and joints, their prescribed motion), `end_effector` (frames; paths of
the end-effector and the joints that follow them), `frozen` (small motions about a pose).
"""
