"""Parts of solid arms: surface, mesh, stress."""
