"""Finite elements of one arm: element matrices, assembly, factorisation, constraint modes.

`Substructure` is an arm whatever its design, `ElasticArm` one design of it; elements fulfil
`elements.Element`.
"""
