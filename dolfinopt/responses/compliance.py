"""Compliance over the whole horizon."""

from __future__ import annotations

from dolfinopt.responses.motion import ComplianceResponse
from dolfinopt.responses.response import register


@register
class IntegralCompliance(ComplianceResponse):
    """Integral of q' K q over the horizon, trapezoidal rule, N m s."""

    name, label, unit = "compliance", "integral of the compliance", "N m s"
