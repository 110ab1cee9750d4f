"""Plug-ins: from a name in the scenario to code of the user's own, and the door through which it is called."""
