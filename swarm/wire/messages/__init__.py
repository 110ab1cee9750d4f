"""Every message on the wire: frozen types whose tag (`schema`) names the type and the wire version: "marks/1".

How bytes become one of them is in `codec`, what their fields are made of in `fields`. An instance that was decoded
holds what its docstring and checks say; whether a cell lies in the grid is for the reader to check.
"""
