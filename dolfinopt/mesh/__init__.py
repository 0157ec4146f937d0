"""Meshes of arms, from cells, Gmsh geometries, mesh files or STEP.

arm_mesh: `ArmMesh`, what all else works on. compat: DOLFINx of several versions.
"""
