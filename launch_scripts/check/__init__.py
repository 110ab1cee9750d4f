"""Checks before a swarm runs: of a scenario, of this machine, of a plug-in.

Each check yields findings (`findings`): a sentence with the key or the part of the machine, the value found, the
value expected and the remedy. A failure prevents the run; a warning states that it differs from what one may
expect. `swarm check` and `swarm up` ask the same functions of `scenario_check`, `swarm doctor` those of
`machine_check`. `plugin_check` is the test kit for a plug-in of one's own.
"""

from swarm.errors import require

require(__name__, "numpy")
