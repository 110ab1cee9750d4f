"""The sub-commands of `swarm`; each module is one."""
