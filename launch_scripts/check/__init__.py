"""What can be known before a swarm runs: of a scenario, of this machine, of a plug-in.

Each check yields findings (`findings`): a sentence that names the key or the part of the machine, says what was
found, what is expected and what to do, and whether it cannot run so (a failure) or runs otherwise than one may
think (a warning). `swarm check` and `swarm up` ask the same functions of `scenario_check`, `swarm doctor` those of
`machine_check`. `plugin_check` is the test kit for a plug-in of one's own.
"""
