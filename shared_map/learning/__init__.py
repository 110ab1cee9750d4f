"""What vehicles learn while they drive: how much the pace of a kind of ground differs from its prior."""
