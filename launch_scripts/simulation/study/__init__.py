"""Studies: scenarios x settings x seeds through the simulation, over many processes or machines."""
