"""The processes of a run on this machine: start, watch, restart, stop, show."""
