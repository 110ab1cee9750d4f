"""Routes asked for, and written for other programs."""
