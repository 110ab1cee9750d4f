"""What everybody agrees on: grid, words, wire, clock and loop. Imports none of the other packages."""
