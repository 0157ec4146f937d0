"""Finite elements of one arm: element matrices, assembly, factorisation, constraint modes."""
