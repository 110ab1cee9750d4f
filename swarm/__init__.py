"""Definitions shared by all processes: grid, wire, bus, settings, clock and loop. Imports none of the other
packages."""
