"""Every message on the wire: frozen types whose tag (`schema`) names the type and the wire version: "marks/1".

`codec` decodes them, `fields` has the types of their fields. A decoded message keeps the rules of its docstring and
checks; whether its cells lie in the grid is checked by its reader.
"""
