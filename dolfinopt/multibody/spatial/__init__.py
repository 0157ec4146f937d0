"""Machines in space: trees of rigid and flexible bodies, their forces, tangents and gradients.

`rotations` (rotation vectors), `mechanism` (bodies and joints), `motion` (prescribed joints),
`kinematics` (from body to body), `inverse_dynamics` (forces), `tangent` (their derivative by the
coordinates), `body_gradient` (by the bodies), `end_effector`; `end_path`, `following` and
`inverse_kinematics` (joints of an end-effector's path). Plane machines need none of it.
"""
