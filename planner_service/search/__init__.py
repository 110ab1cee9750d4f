"""Where a target may be that nobody sees, and who looks where."""
