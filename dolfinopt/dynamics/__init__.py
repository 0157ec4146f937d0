"""Time integration to a tolerance: what is solved, by which method, and the gradient through it.

What: `system` (the interface), `elastic_system` (prescribed rigid coordinates), `batch_system`
(several of them), `modal_coordinates` (its preconditioner). How: `radau` refines time grids,
`batch` those of many, `march` solves by `newton` with `newton_matrix` or `simplified_newton` on
`collocation` stages, `error_estimate` and `unresolved` judge; `generalized_alpha` for comparison.
Results: `solution`, `simulation` (of a scene); gradient: `adjoint`.
"""
