"""Flexible bodies, the mechanism they make, and its dynamics; plain NumPy over instants.

One file a thing, imports one way: `dimension` (what differs between plane and space, rotations),
`shape_integrals` (inertia of one body), `body` (its forces, their tangent and gradient), `tree`
(joints, mechanism), `frames` (from a body to those that hang on it), `kinematics` (poses),
`newton_euler` (forces and elastic residual), `tangent`, `gradient`, `closures`, `loads`. A scene
becomes a machine in `build` alone.
"""
