"""The network of a process: one protocol (`bus`), on Zenoh for real processes and in memory for simulations.

The rules that both keep, about threads, order, losses, deadlines and rejections, stand at the top of `bus`.
`tests/support/bus_behaviour.py` holds both to them. Whatever a payload holds, it is checked and counted before a
service sees it (`zenoh_intake`); a router admits by certificate what the table of topics grants (`access_control`).
"""
