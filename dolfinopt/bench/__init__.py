"""Work-precision diagrams: seconds against error, against references of their own.

A diagram measures rows, step by step; its panels and its goals are made of their data frame.
"""
