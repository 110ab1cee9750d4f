"""The scenario: its structs, how it is read, and what is wrong with one."""
