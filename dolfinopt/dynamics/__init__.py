"""Time integration of a mechanism: Radau IIA on the whole horizon, generalised-alpha, adjoint."""
