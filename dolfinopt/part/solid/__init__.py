"""Parts of solid arms: surface, and the free surface as variables."""
