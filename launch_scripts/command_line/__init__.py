"""The command line itself: families of commands, completion, and what is said of mistakes."""
