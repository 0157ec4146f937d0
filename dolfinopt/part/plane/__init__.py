"""Parts of plates: outline, curves, mesh, stress, and the free outline as variables."""
