"""What vehicles see: the ground around them and targets."""
