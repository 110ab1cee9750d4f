"""The whole swarm in one process, on a memory bus and a manual clock, with seeded faults.

A seed decides everything: worlds (`sample_worlds`), faults (`faults`) and each event, byte for byte.
`simulate` runs the same services as a live run, built in one place for simulations and for the replay of
recordings. `laws` says what must hold in every run, `trials` tries a seed, `study` sums many up, and `study_sweep`
spreads their seeds over processes and machines (Dask).
"""
