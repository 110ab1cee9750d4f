"""A swarm on several machines: how many it needs, who runs where, what each machine is given, and who may do what.

`hosts.toml` names machines. A plan puts every process on one of them, keepers and the processes of one
job apart (`machine_plan`). Each machine gets an archive (`machine_archives`) with the scenario as it runs there,
certificates for its own processes (`certificates`), and a systemd service or a
compose file (from `templates`). The same scenario and machines give the same plan.
`machines_needed` says how many machines a swarm needs."""
