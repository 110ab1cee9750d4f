"""The scenario: its structs, what each setting means, how a file is read, and what is wrong with one."""
