"""The whole swarm in one process, on a memory bus and a manual clock, with seeded faults.

A seed decides everything: worlds (`worlds`), faults (`faults`) and each event, byte for byte. `node` is a process:
the same services as in a live run, built in one place for simulations and for the replay of recordings. `simulate`
runs nodes, `laws` says what must hold in every run, `trials` tries a seed, `study` sums many up.
"""
