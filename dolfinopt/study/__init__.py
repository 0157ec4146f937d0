"""Studies: many optimisations and simulations of variants of a scene, and tables of them.

Plans of labelled `cases` (`plans`, `sweep`, `presets`, `uncertainty`) -> results kept by what they
compute (`store`; `simulate` is what one rank does, `tasks` shares the work out) -> one data frame
-> tables and figures (`tables`, `figures`). `variants` changes scenes; `studies` is the beginning.
"""
