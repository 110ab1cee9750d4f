"""The loop of a process, its membership in a run, and what it counts about itself."""
