"""Studies: many optimisations and simulations of variants of a scene, and tables of them.

Plans of labelled `cases` (`studies`, `uncertainty`) -> results kept by what they compute, shared
out over the ranks by a `Runner` -> one data frame -> `tables` and `figures`. `variants` changes
scenes; `before_after` compares two runs of a machine, `sections` a design with straight tubes and
bars, `motions` one machine on several motions.
"""
