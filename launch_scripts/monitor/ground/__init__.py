"""What lies still in the view: the terrain, its colours, windows."""
