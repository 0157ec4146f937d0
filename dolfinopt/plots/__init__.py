"""Pictures: designs, curves, animation, studies."""
