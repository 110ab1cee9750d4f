"""Studies: scenarios x settings x seeds through the simulation, over many processes or machines.

A study's file (`study`) becomes cases, and each case trials, whose key is a digest of all that decides the result.
`sweep` runs missing trials on Dask's workers and keeps results as they come, `summary` reports the outcomes, with
intervals.
"""
