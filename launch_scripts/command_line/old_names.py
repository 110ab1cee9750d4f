"""Names of commands and options from before 0.2, and words of other programs for the same purpose."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from swarm.config.explain import choice

COMMANDS = {
    "router": "role router", "keeper": "role keeper", "planner": "role planner", "agent": "role agent",
    "targets": "role targets", "monitor": "role monitor", "compare": "runs compare", "report": "runs report",
    "export": "runs export", "replay": "runs replay", "group": "order group", "set": "order set",
    "zone": "order zone", "target": "order target", "vehicle": "order vehicle", "ros2": "gateway ros2",
    "mavlink": "gateway mavlink", "orders": "order ls", "zone list": "order zone ls",
    "vehicle go": "order vehicle start", "vehicle gone": "order vehicle forget", "map": "marks",
    "map inspect": "marks show", "map learned": "marks factors", "plugins": "plugin", "plugins list": "plugin ls",
    "sweep": "study run", "terrain synth": "terrain generate",
}  # fmt: skip
"""Old words -> new words."""
OPTIONS = {
    "order zone add": {"--until": "--for"},
    "runs replay": {"--until": "--until-s"},
    "runs export": {"--mcap": "--format=mcap"},
    "route": {"--row": "swarm route --from cell:ROW,COL"},
    "order set": {"--as-scenario": "swarm order unset KEY"},
    "order group": {"--as-scenario": "swarm order unset groups.NAME"},
}
"""Command -> old option -> new option. In place of a whole command the option still works as it is."""
_SYNONYMS = {
    "start": ("up", "start"), "run": ("up",), "stop": ("down", "stop"), "quit": ("down",), "log": ("logs",),
    "list": ("ls", "ps"), "ls": ("ps",), "init": ("new",), "create": ("new", "add"), "version": ("--version",),
    "delete": ("remove",), "rm": ("remove",), "plan": ("deploy plan",),
    "dem": ("terrain info",), "watch": ("top",), "validate": ("check",),
    "bench": ("./launch_scripts/bench of a checkout",), "chaos": ("./launch_scripts/bench chaos of a checkout",),
}  # fmt: skip
"""Word that other programs have, or we had -> our words, the first of which that a group knows is meant."""


def current(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns the words of a command line with new names for old ones, and a sentence about each of these."""
    old = next((old for old in (" ".join(words[:2]), *words[:1]) if old in COMMANDS), "")
    called = [*COMMANDS.get(old, "").split(), *words[len(old.split()) :]]
    told = [f"`swarm {old}` is now `swarm {COMMANDS[old]}`"] if old else []
    path = " ".join(called)
    renamed = next((renames for name, renames in OPTIONS.items() if f"{path} ".startswith(f"{name} ")), {})
    for place, word in enumerate(called):
        option, equals, value = word.partition("=")
        new = renamed.get(option, "")
        told += [f"`{option}` is now `{new.replace('=', ' ')}`"] if new else []
        if new.startswith("--"):
            called[place] = f"{new}{equals}{value}"
    return called, [f"{each}; the old name goes in 0.3" for each in dict.fromkeys(told)]


def meant(word: str, known: Collection[str]) -> str:
    """Returns the end of a sentence about an unknown command: the command which is meant, or all that are known."""
    file = (f"up {word}", f"info {word}") if "." in word else ()
    found = (each for each in _SYNONYMS.get(word, file) if each.split()[0] in known or each[0] in "-.")
    synonym = next(found, None)
    return choice(word, list(known), " there are: ") if synonym is None else f"; did you mean {synonym!r}?"
