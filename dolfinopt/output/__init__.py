"""What a run leaves in its folder: fields, histories, summary, checkpoint."""
