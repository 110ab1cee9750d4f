"""Arrays in, arrays out: all that is compiled. `rules` says how arrays are laid out."""
