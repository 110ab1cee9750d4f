"""Arrays in, arrays out: all that is compiled. `layout` says how arrays are laid out."""
