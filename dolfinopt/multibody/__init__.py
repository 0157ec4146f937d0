"""Reduced bodies and the mechanism they make: shape integrals, inverse dynamics, motions."""
