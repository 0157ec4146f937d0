"""Time integration to a tolerance, the machine's equations, and gradients through the motion.

What is solved: `system` (the interface), `machine_system` (unknowns), `machine_instants` (the
equations), `feed_forward`, `modes`; `build` alone reads the scene, `tables` gives what files hold.
How: `radau` (one strategy) over `collocation`, `newton_matrix`, `newton`, `march`, `estimate`,
`time_grid`; `adjoint` back. Results: `trajectory`, `budget`, `state_space`.
"""
