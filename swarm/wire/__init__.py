"""What travels: messages, their fields and columns, keys, and the codec at the door."""
