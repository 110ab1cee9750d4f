"""Cost map to tree to route: one process per target."""
