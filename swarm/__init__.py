"""What all processes agree on: grid, wire, bus, settings, clock and loop. Imports none of the other packages."""
