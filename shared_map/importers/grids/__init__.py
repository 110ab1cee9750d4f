"""Heights in plain text, tables and arrays."""
