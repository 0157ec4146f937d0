"""Paths over time, as plain data: time laws from rest to rest, and tables of points or joints."""
