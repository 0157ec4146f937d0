"""What a design does: objectives and constraints, their values and gradients."""
