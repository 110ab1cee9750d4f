"""What can be known before anything starts: of a scenario, of the ground that it names, and of this machine."""
