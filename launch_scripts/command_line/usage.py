"""What is said of a mistake at the command line: one sentence with the option, what was found, what is allowed."""

from __future__ import annotations

import typing
from collections.abc import Sequence
from typing import Any

from typer.exceptions import TyperException

from swarm.config.explain import UNBOUNDED, choice, nearest
from swarm.config.input_files import quoted


def sentence(error: TyperException) -> str:
    """What typer found wrong, in words of this command. Empty where it has printed help itself."""
    # The classes themselves are private to typer.
    kind = type(error).__name__
    if kind == "NoArgsIsHelpError":
        return ""
    ctx: Any = getattr(error, "ctx", None)
    said = _SAID.get(kind, _of_usage)(error, ctx)
    return said if ctx is None else f"{said}; `{ctx.command_path} -h` explains"


def _of_option(error: Any, ctx: Any) -> str:
    known = [name for param in ctx.command.get_params(ctx) for name in param.opts if name.startswith("-")]
    # `-h` is near to any other short option.
    close = nearest(error.option_name, [name for name in known if name.startswith("--")])
    return f"no option {error.option_name}{close}"


def _of_missing(error: Any, ctx: Any) -> str:
    param = error.param
    if param.param_type_name == "argument":
        return f"give {param.metavar or param.name.upper()}{_meant(param)}"
    return f"give {param.opts[-1]}{_meant(param)}"


def _meant(param: Any) -> str:
    text = (param.help or "").rstrip(".")
    return f": {text[:1].lower()}{text[1:]}" if text and len(text) <= 120 else ""


def _of_value(error: Any, ctx: Any) -> str:
    param = error.param
    name = param.opts[-1] if param.param_type_name == "option" else param.metavar or param.name.upper()
    descriptor = param.type_descriptor
    cause: Sequence[Any] = getattr(error.__cause__, "errors", list)()
    found = quoted(cause[0]["input"]) if cause else "something else"
    if descriptor.choices:
        allowed = [str(getattr(each, "value", each)) for each in descriptor.choices]
        return f"{name}: found {found}{choice(found.strip(chr(39)), allowed)}"
    return f"{name}: found {found}, expected {_expected(param, cause)}"


def _expected(param: Any, cause: Sequence[Any]) -> str:
    kinds = [kind_of(param)]
    words = {float: "a number", int: "a whole number"}.get(kinds[0], "something else")
    lowest, highest = getattr(param, "min", None), getattr(param, "max", None)
    if highest is not None and highest >= UNBOUNDED:
        highest, words = None, f"{words}, smaller than {highest:g}"
    if lowest is not None and highest is not None:
        return f"{words}, {lowest:g} to {highest:.12g}"
    if lowest is not None:
        return f"{words}, at least {lowest:g}"
    if highest is not None:
        return f"{words}, at most {highest:g}"
    if words == "something else" and cause:
        return str(cause[0]["msg"]).removeprefix("Value error, ")
    return words


def kind_of(param: Any) -> Any:
    """The type of one value of an option or argument."""
    hint = param.type_descriptor.annotation
    return typing.get_args(hint)[0] if typing.get_origin(hint) in (list, tuple) else hint


def _of_option_usage(error: Any, ctx: Any) -> str:
    lacks = "requires" in error.message
    return f"{error.option_name} {'needs a value after it' if lacks else 'takes no value'}"


def _of_usage(error: Any, ctx: Any) -> str:
    message: str = error.message
    if message.startswith("No such command "):
        word = message.split("'")[1]
        commands = ctx.command.list_commands(ctx)
        return f"no command {word!r}{choice(word, commands, ' there are ')}"
    if message.startswith("Got unexpected extra argument"):
        words = message.partition("(s) (")[2].removesuffix(")").split()
        return f"{words[0]!r} is one too many"
    if message == "Missing command.":
        return f"give a command: {', '.join(ctx.command.list_commands(ctx))}"
    return message.rstrip(".")


_SAID = {
    "NoSuchOption": _of_option,
    "MissingParameter": _of_missing,
    "BadParameter": _of_value,
    "BadOptionUsage": _of_option_usage,
}
