"""Inertia of rigid bodies in space, as URDF states it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

Moment = Annotated[float, Field(ge=0, le=1e9)]  # kg m2
Product = Annotated[float, Field(ge=-1e9, le=1e9)]
Tensor = tuple[Product, Product, Product, Product, Product, Product]  # xx, yy, zz, xy, xz, yz
# By how much, over the largest, rounded moments may miss the triangle inequality.
ROUNDED = 1e-6


def tensor_problem(inertia: float | tuple[float, ...] | None) -> str:
    """Return why no body has this inertia tensor, "" for one that a body may have.

    Its principal moments are int y^2 + z^2 and so on: none is negative, or more than the sum of
    the two others.
    """
    if not isinstance(inertia, tuple) or not any(inertia):
        return ""
    import numpy as np  # which scenes in the plane do not need

    xx, yy, zz, xy, xz, yz = inertia
    low, middle, high = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = f"its principal moments are {low:.4g}, {middle:.4g} and {high:.4g} kg m2"
    if low < -ROUNDED * max(abs(low), high):
        return f"expected the inertia of a body: {moments}, and none can be negative"
    if low + middle < (1.0 - ROUNDED) * high:
        return (
            f"expected the inertia of a body: {moments}, and none can exceed the sum of the two "
            "others"
        )
    return ""
