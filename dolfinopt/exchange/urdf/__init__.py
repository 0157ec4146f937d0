"""Robots as URDF files: read and checked, as bodies and joints of a scene, written back.

`robot` (links, joints, frames), `read`, `checks` (inertias that cannot be), `bodies` (which links
are bodies of a scene), `solids` (their frames), `geometry` (their shapes), `trajectory`, `scene`
(the text of a scene file), `write`.
"""
