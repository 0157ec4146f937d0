"""Robots as URDF files: bodies and joints of a scene, and back.

`robot` (links, joints, frames; which links are bodies of a scene; closed loops), `file` (read,
checked, written back), `geometry` (shapes of links as cells), `scene` (the text of a scene file,
its trajectory).
"""
