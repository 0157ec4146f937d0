"""Which program this is: what is kept under another version or number is computed anew."""

__version__ = "0.1.0"
# Raise it with every change that alters results: of the finite elements, reductions, simulation,
# gradients or optimiser, beyond rounding; and with every change of the files that are kept of
# them.
NUMERICS = 12
