"""Moving entities in the view: vehicles, targets, obstacles, their routes and trails, beliefs, alarms.

`movers_view` hears and draws, with `vehicles_view` for vehicles, their trails and routes. `styles` is the one table
of colours and of how much is drawn for how many vehicles.
"""
