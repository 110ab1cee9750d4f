"""Route to motion to marks: many vehicles per process."""
