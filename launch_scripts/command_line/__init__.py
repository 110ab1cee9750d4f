"""Command line: families of commands, completion, and sentences for mistakes."""
