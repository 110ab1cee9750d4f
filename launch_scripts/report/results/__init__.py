"""What a run leaves in its folder, as numbers."""
