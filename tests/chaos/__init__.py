"""A live swarm under faults: killed and stopped processes, hostile messages; how soon it recovers.

`fault_schedule` decides by a seed what falls on whom, `run` starts a swarm, strikes it through an `attacker`, and
watches: `recovery` says since when vehicles are routed and move again, `results` which laws broke.
"""
