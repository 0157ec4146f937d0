"""Model reduction: each method a function with one signature, and an adjoint where one exists."""

from dolfinopt.reduction.basis import AdjointFields, Basis, Options, by_frame_fields, frame_fields
from dolfinopt.reduction.methods import METHODS, Method, balanced, craig_bampton, krylov, modal

__all__ = [
    "METHODS",
    "AdjointFields",
    "Basis",
    "Method",
    "Options",
    "balanced",
    "by_frame_fields",
    "craig_bampton",
    "frame_fields",
    "krylov",
    "modal",
]
