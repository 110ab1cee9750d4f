"""What a photo shows: classes of ground, and roads."""
