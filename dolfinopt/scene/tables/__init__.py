"""The tables of a scene, a file each: keys, types, limits, units, and what they must agree on."""
