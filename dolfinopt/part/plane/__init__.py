"""Parts of plates: outline and curves, truss layouts, and the free outline as variables."""
