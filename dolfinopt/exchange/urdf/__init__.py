"""Robots as URDF files: read and checked, as bodies and joints of a scene, written back.

`robot` (links, joints, frames), `read`, `checks` (inertias that cannot be), `bodies` (which links
become solids, their frames), `trajectory`, `scene` (the text of a scene file), `write`.
"""
