"""What travels between processes: messages, their fields and columns, topics and keys, and the codec."""
