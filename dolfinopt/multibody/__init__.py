"""Flexible bodies, the mechanism they make, and its prescribed motion; plain NumPy over instants.

`shape_integrals` (inertia of one body) -> `mechanism` (bodies on a cart, payload) -> `motion`
(rigid coordinates that follow a path) -> `inverse_dynamics` (forces and elastic residual).
Derivatives: `tangent` by rigid and elastic coordinates, `body_gradient` by the bodies' integrals,
`end_effector` of its position. Scenarios side by side: `instants`. Other programs: `mbdyn`,
`standard_input`.
"""
