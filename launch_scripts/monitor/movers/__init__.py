"""What moves in the view: vehicles, targets, bodies, their routes and trails."""
