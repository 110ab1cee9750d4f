"""The command `swarm`. A small install has the client library only, and this says what to install."""

from __future__ import annotations

import sys

from launch_scripts.web.health_probe import fast
from swarm.errors import EXTRAS, ConfigError, missing, require

_OURS = ("launch_scripts", "planner_service", "shared_map", "swarm", "vehicle_agent")
_RUNS = {"demo": "view", "up": "view", "simulate": "roles"}
"""Commands that run a swarm, with the extra that a user installs for it."""
_NEEDED = [
    package
    for package, extra in EXTRAS.items()
    if extra in ("planner", "terrain", "roles") and package != "setproctitle"  # it only names processes
]
"""Packages of its processes, which are looked for before anything runs."""
_SAYS_MORE = ("-h", "--help", "--only", "-d", "--detach")
"""With words that begin so it is for the command to say which processes, if any."""


def main() -> int:
    if sys.argv[1:2] == ["health"] and (code := fast(sys.argv[1:])) is not None:
        return code
    extra = _RUNS.get("".join(sys.argv[1:2]), "terrain")
    try:
        if extra != "terrain" and not any(word.startswith(_SAYS_MORE) for word in sys.argv[2:]):
            require("the command", *_NEEDED)
            if extra == "view":
                # It takes longest of all that a start waits for, so it begins before the command itself is loaded.
                from launch_scripts.launcher.forkserver import ROLES_AND_KERNELS, start_forkserver

                start_forkserver(ROLES_AND_KERNELS)
        from launch_scripts.cli import main as run
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in _OURS:
            raise  # a fault of ours
        print(f"swarm: the command needs {missing(error.name or '', extra)}", file=sys.stderr)
        return ConfigError.exit_code
    except KeyboardInterrupt:
        print("swarm: stopped", file=sys.stderr)
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
