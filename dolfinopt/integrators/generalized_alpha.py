"""Generalised-alpha, step by step."""
