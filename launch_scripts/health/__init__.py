"""Whether processes live and are ready, for those who ask from outside: probes, supervisors, people."""
