"""Plug-ins: from a name in the scenario to code of the user's own, and the guard through which it is called."""
