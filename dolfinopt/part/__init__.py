"""From density to part: the outline or surface of every arm, what it does, files for the workshop.

plane, solid: parts of plates and of solid arms, from their design to their mesh and its stress.
check: the machine with the parts beside the one with the densities.
optimize: the scene's objective within its limits, by the sides of the parts.
workshop_files: what is written, by format. folder: all files together, part.toml among them.
"""
