"""Time integration to a tolerance, the machine's equations, and gradients through the motion.

What is solved: `system` (the interface), `elastic_system` (prescribed joints), `machine_system`
(drives, closed loops); `build` makes them of a scene, `tables` gives what files hold. How:
`radau` (one strategy) over `collocation`, `newton_matrix`, `newton`, `march`, `estimate`,
`time_grid`; `adjoint` back. Results: `simulation`, `budget`, `state_space`.
"""
