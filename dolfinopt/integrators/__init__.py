"""Time integrators of the elastic coordinates under prescribed rigid motion.

Each takes an `ElasticProblem` and a tolerance, and returns a `Solution` with its estimated error.
"""
