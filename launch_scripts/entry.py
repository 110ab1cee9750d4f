"""The command `swarm`. A small install has the client library only, and this says what to install."""

from __future__ import annotations

import sys

from launch_scripts.web.health_probe import fast
from swarm.errors import EXTRAS, ConfigError, missing, require

_OURS = ("launch_scripts", "planner_service", "shared_map", "swarm", "vehicle_agent")
_RUNS = ("demo", "up")
"""Commands that start processes."""
_NEEDED = [
    package
    for package, extra in EXTRAS.items()
    if extra in ("planner", "terrain", "roles") and package != "setproctitle"  # it only names processes
]
"""Packages of their processes."""
_SAYS_MORE = ("-h", "--help", "--only", "-d", "--detach")
"""With words that begin so it is for the command to say which processes, if any."""


def main() -> int:
    if sys.argv[1:2] == ["health"] and (code := fast(sys.argv[1:])) is not None:
        return code
    try:
        runs = sys.argv[1:2] and sys.argv[1] in _RUNS
        if runs and not any(word.startswith(_SAYS_MORE) for word in sys.argv[2:]):
            require("the command", *_NEEDED)
            # It takes longest of all that a start waits for, so it begins before the command itself is loaded.
            from launch_scripts.launcher.forkserver import ROLES_AND_KERNELS, start_forkserver

            start_forkserver(ROLES_AND_KERNELS)
        from launch_scripts.cli import main as run
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in _OURS:
            raise  # a fault of ours
        print(
            f"swarm: the command needs {missing(error.name or '', 'view' if runs else 'terrain')}", file=sys.stderr
        )
        return ConfigError.exit_code
    except KeyboardInterrupt:
        print("swarm: stopped", file=sys.stderr)
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
