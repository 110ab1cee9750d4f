"""Turns functions into commands of Typer, and runs them: options come from a signature, what they mean from its
docstring.

A command is a function and `@command(app, PANEL)`. Its docstring is its help: prose and examples, and rows
`name  meaning` for its arguments and options, as the docstrings of scenario sections have them. A parameter without
a default is an argument, one with a default an option; `Annotated[..., typer.Option(...)]` says what else there is,
such as bounds or completion. A parameter whose type is a dataclass stands for one option per field, which the
class's own docstring explains: options that several commands share are declared and explained once. The function
returns the exit code.
"""

from __future__ import annotations

import contextlib
import errno
import inspect
import os
import pkgutil
import re
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import fields, is_dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import msgspec
import typer
from typer.core import TyperCommand, TyperGroup
from typer.exceptions import TyperException

from launch_scripts.plain_text import plain
from launch_scripts.report import AREAS, FORMATS, SEVERAL
from swarm.config.explain import bounds_of, choice, meanings, nearest
from swarm.config.input_files import quoted
from swarm.errors import EXTRAS, ConfigError, StoreError, SwarmError, missing
from swarm.files import discard_output

F = TypeVar("F", bound=Callable[..., int | None])

RUN = "Run a swarm"
PREPARE = "Before a run"
ASK = "Ask a running swarm"
ORDER = "Give a running swarm orders"
LEFT = "Finished runs"
ADMIN = "Processes, machines and other systems"
"""The panels in which help shows commands."""

NETWORK = "Where the swarm is"
CERTIFICATES = "Certificates (a folder, or all three files)"
PART = "A part of a swarm"
"""The panels in which help shows options."""

CONTEXT = {"help_option_names": ["-h", "--help"]}
"""Settings of every command, which inherits them from the root."""
_ROW = re.compile(r"\w+(, \w+)*  +\S")
_LISTS = {"layers": ", ".join(FORMATS), "areas": ", ".join(AREAS), "several": " and ".join(SEVERAL)}
"""Formats for which a word in braces stands, in the row of an option: a new format is in every help."""
_AS_IT_STANDS = (" ", "\b", "[", "swarm ")
"""Lines of examples and tables begin so: they keep their line ends, whereas prose fills the terminal's width."""


def command(
    app: typer.Typer, panel: str | None = None, name: str | None = None, **settings: Any
) -> Callable[[F], F]:
    """Adds a function to an app as a command, and returns the function as it is.

    settings  what else Typer takes of a command
    """

    def added(function: F) -> F:
        made = app.command(name, cls=Command, rich_help_panel=panel, help=_prose(function.__doc__), **settings)
        made(_called_with_options(function))
        return function

    return added


class Command(TyperCommand):
    """A command whose help has short types, and which takes no option twice that has one value: the last would
    win without a word."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if ctx.resilient_parsing:  # at completion
            return super().parse_args(ctx, args)
        given: list[Any] = self.make_parser(ctx).parse_args(args=list(args))[2]
        once = [each for each in given if each.param_type_name == "option" and not (each.multiple or each.is_flag)]
        if twice := next((each for each in once if once.count(each) > 1), None):
            raise ConfigError(f"{twice.opts[0]} is given {once.count(twice)} times, and takes one value")
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        TyperCommand.format_help(with_short_types(self, ctx), ctx, formatter)


_NUMBERS = {int: "INTEGER", float: "NUMBER"}


def with_short_types(command: Any, ctx: Any) -> Any:
    """A copy of a command for its help: the bounds of a number stand in words behind its meaning, and a flag has no
    type. In the column of types, where Typer has both, they would break words at 80 columns."""
    from typer import rich_utils

    rich_utils.RANGE_STRING = ""
    copied = copy(command)
    copied.params = [copy(each) for each in command.params]
    for each in copied.get_params(ctx):
        if bounds := ", ".join(bounds_of(msgspec.Meta(ge=each.min, le=each.max))):
            each.help = f"{each.help} \\[{bounds}]"
        if each.param_type_name == "option":
            usual = _NUMBERS.get(each.type_descriptor.annotation) or re.sub(
                r"list\[|\]", "", each.display_type(ctx)
            )
            each.metavar = "" if each.is_flag else each.metavar or usual
    return copied


def family_app(help: str) -> typer.Typer:
    """The app of a sub-command that has sub-commands of its own."""
    return typer.Typer(help=_prose(help), no_args_is_help=True, add_completion=False)


def _prose(docstring: str | None) -> str:
    """The prose of a docstring, each paragraph on one line, without the rows that explain options."""
    paragraphs = re.split(r"\n\s*\n", inspect.cleandoc(docstring or ""))
    return "\n\n".join(
        each if any(line.startswith(_AS_IT_STANDS) for line in each.splitlines()) else " ".join(each.split())
        for each in paragraphs
        if not _ROW.match(each)
    )


def _called_with_options(function: Callable[..., int | None]) -> Callable[..., None]:
    """The function as Typer reads it: every dataclass parameter is replaced by the fields of its class."""
    texts = {name: text.format(**_LISTS) for name, text in meanings(function).items()}
    groups: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []
    for each in inspect.signature(function, eval_str=True).parameters.values():
        if not is_dataclass(each.annotation):
            parameters.append(_parameter(each.name, each.annotation, each.default, texts.get(each.name)))
            continue
        group: Any = each.annotation
        groups[each.name] = group
        bases: list[Any] = [base for base in reversed(group.__mro__) if is_dataclass(base)]
        rows = {name: (text, base.panel) for base in bases for name, text in meanings(base).items()}
        hints = get_type_hints(group, include_extras=True)
        for field in fields(group):
            text, panel = rows.get(field.name, (None, group.panel))
            parameters.append(_parameter(field.name, hints[field.name], field.default, text, panel))

    def run(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in fields(group)})
        if code := function(**values):
            raise typer.Exit(code)

    run.__name__ = function.__name__
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def _parameter(name: str, hint: Any, default: Any, text: str | None, panel: str | None = None) -> inspect.Parameter:
    """A parameter with its meaning; one that is true or false is given as `--name` alone."""
    kind, *declared = (hint.__origin__, *hint.__metadata__) if hasattr(hint, "__metadata__") else (hint,)
    is_argument = default is inspect.Parameter.empty
    info = copy(declared[0]) if declared else typer.Argument() if is_argument else typer.Option()
    info.help = text or info.help
    info.rich_help_panel = panel
    if kind is bool and not isinstance(info.default, str):  # where Typer keeps a name that is declared
        info.param_decls = (f"--{name.replace('_', '-')}",)
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info]
    )


def from_environment(variable: str, **more: Any) -> Any:
    """An option whose value may be in a variable of the environment: `SWARM_NAMESPACE` for `--namespace`."""
    return typer.Option(envvar=variable, show_envvar=False, **more)


class Family(TyperGroup):
    """A group whose commands are those of a Typer app, `MODULE:APP`, which is imported when one is asked for.

    help  the line beside its name among the other commands; the app has a longer one of its own
    """

    def __init__(self, name: str, module: str, help: str, panel: str) -> None:
        self.module = module
        super().__init__(name=name, help=help, no_args_is_help=True, rich_help_panel=panel, suggest_commands=False)

    @cached_property
    def group(self) -> Any:
        """The group of the app itself."""
        return typer.main.get_group(pkgutil.resolve_name(self.module))

    @property
    def commands(self) -> Any:
        return self.group.commands

    @commands.setter
    def commands(self, none_yet: Any) -> None:
        """Typer gives a new group the commands that it knows, and of a family it knows none."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        with_short_types(self.group, ctx).format_help(ctx, formatter)


# --- completion: nothing here may fail or take long, as the user has pressed the Tab key ------------------------


def complete_scenarios(ctx: typer.Context, incomplete: str) -> list[str]:
    """Built-in scenarios, and .toml files below the folder that the word begins with."""
    from launch_scripts.launcher.run_options import SCENARIOS

    built_in = sorted(file.stem for file in SCENARIOS.glob("*.toml"))
    return [name for name in [*built_in, *_files_of(incomplete)] if name.startswith(incomplete)]


def complete_runs(ctx: typer.Context, incomplete: str) -> list[str]:
    """Names of the runs in --runs and of those that are registered, the newest first, and LAST."""
    from launch_scripts.observe.run_folders import registered

    names = {run.name for run in registered()}
    with contextlib.suppress(OSError):
        names |= {each.name for each in Path(ctx.params.get("runs") or "runs").iterdir() if each.is_dir()}
    return [name for name in sorted(names, reverse=True) if name.startswith(incomplete)]


def _files_of(incomplete: str) -> Iterator[str]:
    folder = Path(incomplete) if incomplete.endswith("/") else Path(incomplete).parent
    before = "" if "/" not in incomplete else incomplete[: incomplete.rfind("/") + 1]
    with contextlib.suppress(OSError):
        for each in sorted(folder.iterdir()):
            if each.suffix == ".toml":
                yield f"{before}{each.name}"
            elif each.is_dir() and not each.name.startswith("."):
                yield f"{before}{each.name}/"


# --- a command is run: whatever ends it becomes an exit code and one sentence, never a traceback ----------------

_NO_PATHS = (errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EPERM, errno.ENOTDIR)
"""Errors about a path that cannot be one, or not for this user."""
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)

_NO_MEMORY = ("failed to map segment", "annot allocate memory", "can't start new thread")
"""Words of the loader, of the system and of Python where a library, a file or a thread finds no memory."""


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
        except (ImportError, OSError, RuntimeError) as error:
            if not any(words in str(error) for words in _NO_MEMORY):
                raise
            raise MemoryError from error
        finally:
            sys.stdout.flush()
    except TyperException as error:
        sentence = _sentence(error)
        return _refused(sentence, ConfigError.exit_code) if sentence else ConfigError.exit_code
    except typer.Abort:
        return _refused("stopped; nothing is written", 1)
    except SwarmError as error:
        return _refused("\n".join(map(plain, str(error).split("\n"))), error.exit_code)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise  # a fault of ours
        return _refused(f"this needs {missing(package)}", ConfigError.exit_code)
    except MemoryError:
        return _refused("there is not enough memory for this (`ulimit -v` may be the limit)", SwarmError.exit_code)
    except BrokenPipeError:
        discard_output(1)  # the interpreter would complain at its end about what still waits to be printed
        return 0
    except OSError as error:
        if error.errno in _NO_PATHS and error.filename is not None:
            return _refused(f"{quoted(str(error.filename))}: {error.strerror}", ConfigError.exit_code)
        if error.errno not in _NO_ROOM:
            raise
        if error.filename is None:
            discard_output(1)
        return _refused(f"cannot write {error.filename or 'the output'}: {error.strerror}", StoreError.exit_code)
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    if asked and code == 128 + signal.SIGINT:  # typer leaves at a Ctrl-C without a word, with this code
        print("swarm: stopped", file=sys.stderr)
    return code if isinstance(code, int) else 0


def _refused(sentence: str, code: int) -> int:
    """Prints a sentence to standard error, and returns the exit code."""
    print(f"swarm: {sentence}", file=sys.stderr)
    return code


def _sentence(error: TyperException) -> str:
    """Returns Typer's sentence about a mistake, completed: the value found, the meaning of an argument, the list of
    commands. Empty where Typer has printed help already."""
    if type(error).__name__ == "NoArgsIsHelpError":  # private to Typer, as all of its classes of errors
        return ""
    ctx: Any = getattr(error, "ctx", None)
    param: Any = getattr(error, "param", None)
    wrong: list[Any] = getattr(error.__cause__, "errors", list)()
    text: str = error.format_message()
    if wrong:
        text = text.replace(wrong[0]["msg"], f"found {quoted(wrong[0]['input'])}; {wrong[0]['msg']}")
        text = re.sub("Value error, |, unable to parse [^;]*", "", text).replace("Input should be", "expected")
        text = text.replace("greater than or equal to", "at least").replace("less than or equal to", "at most")
    elif param is not None and text.startswith("Missing") and param.help:
        text = f"{text.removesuffix('.')}: {param.help}"
    elif unknown := re.fullmatch(r"No such command '(.*)'\.", text, re.DOTALL):
        text = text.removesuffix(".") + _meant(unknown[1], ctx)
    elif option := getattr(error, "option_name", None) if text.startswith("No such option") else None:
        names = [name for each in ctx.command.params for name in each.opts]
        there = _elsewhere(option, ctx)
        text = f"No such option: {option}{_asked(there) if there else nearest(option, names)}"
    for before, word in pairwise(sys.argv):
        if re.fullmatch(r"\S*\d,", before) and re.fullmatch(r"[-+.\d]+", word):
            return f"{text.removesuffix('.')}; a place has no blank: did you mean '{before}{word}'?"
    if ctx is None:
        return text
    text = re.sub(r"(?<!\.)\.$", "", text)
    return f"{text}{'' if text.endswith('?') else ';'} `{ctx.command_path} -h` explains"


def _meant(word: str, ctx: Any) -> str:
    """Returns the end of a sentence about an unknown command: the command which is meant, here or in another group,
    or all that are known here."""
    known, singular = ctx.command.commands, word.removesuffix("s")
    file = (f"up {word}", f"info {word}") if "." in word else ()
    synonyms = tomllib.loads(Path(__file__).with_name("synonyms.toml").read_text(encoding="utf-8"))
    words = synonyms.get(f"{ctx.info_name} {word}", synonyms.get(word, file))
    meant = [each for each in words if each.split()[0] in {"swarm", *known} or each[0] in "-."][:1]
    if not meant and singular not in known:
        meant = _elsewhere(singular, ctx)
    return _asked(meant) or choice(word, list(known), " there are: ")


def _asked(meant: list[str]) -> str:
    """Returns the question whether a few words are meant; empty if there are none, or too many to guess."""
    return f"; did you mean {' or '.join(map(repr, meant))}?" if len(meant) in (1, 2, 3) else ""


def _elsewhere(word: str, ctx: Any) -> list[str]:
    """Returns all commands, and options of commands, which have this name or its plural."""
    same = re.compile(rf" {re.escape(word)}s?$")
    return [each for each in _paths(ctx.find_root().command) if same.search(each)]


def _paths(command: Any, words: str = "swarm") -> Iterator[str]:
    """Yields the words of a command, also with each of its options, and those of the commands in it."""
    yield words
    options = (option for each in command.params for option in each.opts if option.startswith("-"))
    yield from (f"{words} {option}" for option in options)
    for name, each in getattr(command, "commands", {}).items():
        yield from _paths(each, f"{words} {name}")


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
