"""Flexible bodies, the mechanism they make, and its prescribed motion; plain NumPy over instants.

`shape_integrals` (inertia of one body) -> `mechanism` (bodies on a cart, payload) -> `motion`
(rigid coordinates that follow a path) -> `inverse_dynamics` (forces and elastic residual).
The recursion, by the dimension of the world (`dimension`): `body` (one body), `kinematics`
(from body to body). Derivatives: `tangent` by coordinates and by the bodies' integrals;
`end_effector`, its place and theirs. Other programs: `standard_input`.
"""
