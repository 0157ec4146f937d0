"""Time integrators of the elastic coordinates under prescribed rigid motion.

One signature: (problem, tolerance, start) -> `Solution` with an estimate of its error.
"""
