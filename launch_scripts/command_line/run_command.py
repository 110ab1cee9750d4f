"""Runs a command: whatever ends it becomes an exit code and one sentence, never a traceback."""

from __future__ import annotations

import errno
import os
import re
import signal
import sys
from collections.abc import Callable, Collection
from itertools import pairwise
from typing import Any

import typer
from typer.exceptions import TyperException

from launch_scripts.plain_text import plain
from swarm.config.explain import choice, nearest
from swarm.config.input_files import quoted
from swarm.errors import EXTRAS, ConfigError, StoreError, SwarmError, missing
from swarm.files import discard_output

_NO_PATHS = (errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EPERM, errno.ENOTDIR)
"""Errors about a path that cannot be one, or not for this user."""
_SYNONYMS = {
    "start": ("up", "start"), "run": ("up",), "stop": ("down", "stop"), "quit": ("down",), "log": ("logs",),
    "list": ("ls", "ps"), "ls": ("ps",), "init": ("new",), "create": ("new", "add"), "version": ("--version",),
    "delete": ("remove",), "rm": ("remove",), "plan": ("deploy plan",),
    "dem": ("terrain info",), "watch": ("top",), "validate": ("check",),
    "bench": ("./launch_scripts/bench of a checkout",), "chaos": ("./launch_scripts/bench chaos of a checkout",),
}  # fmt: skip
"""Word that other programs have, or we had -> our words, the first of which that a group knows is meant."""


def run_command(command: Callable[[], Any], name: str = "swarm") -> int:
    """Runs the command that is made here. Returns its exit code; a fault of the user, a file or the network is
    reported in a sentence."""
    # A shell starts what it puts into the background deaf to SIGINT. An explicit signal is obeyed.
    asked: list[int] = []

    def stop(number: int, frame: object) -> None:
        asked.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, stop)
    _fill_streams()
    try:
        try:
            code = command().main(prog_name=name, standalone_mode=False)
        finally:
            sys.stdout.flush()
    except TyperException as error:
        if said := _sentence(error):
            print(f"swarm: {said}", file=sys.stderr)
        return ConfigError.exit_code
    except typer.Abort:
        print("swarm: stopped; nothing is written", file=sys.stderr)
        return 1
    except SwarmError as error:
        said = "\n".join(map(plain, str(error).split("\n")))
        print(f"swarm: {said}", file=sys.stderr)
        return error.exit_code
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise  # a fault of ours
        print(f"swarm: this needs {missing(package)}", file=sys.stderr)
        return ConfigError.exit_code
    except BrokenPipeError:
        discard_output(1)  # the interpreter would complain at its end about what still waits to be printed
        return 0
    except OSError as error:
        if error.errno in _NO_PATHS and error.filename is not None:
            print(f"swarm: {quoted(str(error.filename))}: {error.strerror}", file=sys.stderr)
            return ConfigError.exit_code
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) or error.filename is not None:
            raise
        discard_output(1)
        print(f"swarm: cannot write the output: {error.strerror}", file=sys.stderr)
        return StoreError.exit_code
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    if asked and code == 128 + signal.SIGINT:  # typer leaves at a Ctrl-C without a word, with this code
        print("swarm: stopped", file=sys.stderr)
    return code if isinstance(code, int) else 0


def _sentence(error: TyperException) -> str:
    """Returns Typer's sentence about a mistake, completed: the value found, the meaning of an argument, the list of
    commands. Empty where Typer has printed help already."""
    if type(error).__name__ == "NoArgsIsHelpError":  # private to Typer, as all of its classes of errors
        return ""
    ctx: Any = getattr(error, "ctx", None)
    param: Any = getattr(error, "param", None)
    wrong: list[Any] = getattr(error.__cause__, "errors", list)()
    said: str = error.format_message()
    if wrong:
        said = said.replace(wrong[0]["msg"], f"found {quoted(wrong[0]['input'])}; {wrong[0]['msg']}")
    elif param is not None and said.startswith("Missing") and param.help:
        said = f"{said.removesuffix('.')}: {param.help}"
    elif unknown := re.fullmatch(r"No such command '(.*)'\.", said, re.DOTALL):
        said = said.removesuffix(".") + _meant(unknown[1], ctx.command.commands)
    elif option := getattr(error, "option_name", None) if said.startswith("No such option") else None:
        names = [name for each in ctx.command.params for name in each.opts]
        said = f"No such option: {option}{nearest(option, names)}"
    for before, word in pairwise(sys.argv):
        if re.fullmatch(r"\S*\d,", before) and re.fullmatch(r"[-+.\d]+", word):
            return f"{said.removesuffix('.')}; a place has no blank: did you mean '{before}{word}'?"
    if ctx is None:
        return said
    said = re.sub(r"(?<!\.)\.$", "", said)
    return f"{said}{'' if said.endswith('?') else ';'} `{ctx.command_path} -h` explains"


def _meant(word: str, known: Collection[str]) -> str:
    """Returns the end of a sentence about an unknown command: the command which is meant, or all that are known."""
    file = (f"up {word}", f"info {word}") if "." in word else ()
    found = (each for each in _SYNONYMS.get(word, file) if each.split()[0] in known or each[0] in "-.")
    synonym = next(found, None)
    return choice(word, list(known), " there are: ") if synonym is None else f"; did you mean {synonym!r}?"


def _fill_streams() -> None:
    """Redirects closed standard streams to nowhere: otherwise the next file that is opened would take their place,
    and receive printed text."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8"))
