"""One HTTP server: the page of the live view, health and metrics."""
