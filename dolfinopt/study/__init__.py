"""Studies: many optimisations and simulations of variants of a scene, and tables of them.

`variants` changes scenes, `sweep` and `presets` plan what to compute, `store` keeps the results by
what they compute, `tasks` shares the work out over ranks; `studies` is where it all begins.
`uncertainty` does the same for random values, with `sampling` and `statistics`.
"""
