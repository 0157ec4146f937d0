"""File formats of other multibody programs, as plain data."""
