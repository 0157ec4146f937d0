"""Topology optimisation of flexible multibody systems on FEniCSx."""

__version__ = "0.1.0"
