"""Designs under varied scene values: store, sweeps, random samples, tables."""
