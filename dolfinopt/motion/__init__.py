"""What moves the rigid coordinates: time laws and tables, paths, inverse kinematics on a tree.

`paths`, `tables`, `plane` (chains of the plane); `poses` (paths in space);
`constraints` (closures and path as equations) -> `start` -> `singular` -> `follower`.
`build` alone knows the scene.
"""
