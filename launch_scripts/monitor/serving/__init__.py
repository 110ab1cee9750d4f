"""Where the view goes: a file, a port, a page."""
