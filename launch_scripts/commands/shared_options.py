"""Options which several commands share: fields of dataclasses that a command takes whole."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from launch_scripts.command_line import complete, panels
from swarm.liveness import HIGHEST_RANK

if TYPE_CHECKING:
    from swarm.config.scenario import TlsConfig

MOST_SECONDS = 1e12
"""As the scenario has it."""
ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="A .toml file, or the name of a built-in scenario such as jacksboro.",
        autocompletion=complete.scenarios,
    ),
]
Namespace = Annotated[
    str | None,
    typer.Option(help="Prefix of all keys: runs in different ones do not meet.", rich_help_panel=panels.NETWORK),
]
Runs = Annotated[Path, typer.Option(help="Folder in which each run gets a folder of its own.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output, all else on standard error.")]
PortOption = Annotated[
    int | None,
    typer.Option(min=0, max=65533, help="Router on this port, live view on the next two; 0 picks free ones."),
]
PresetOption = Annotated[
    str | None,
    typer.Option(
        "--preset",
        help="With a terrain file: hiker, wheeled, tracked or quadruped, as cost.preset.",
        autocompletion=complete.words("swarm.config.values", "Preset"),
    ),
]
SignalsAddress = Annotated[
    str,
    typer.Option(
        metavar="ADDRESS",
        help="Where the port of figures and health listens: 0.0.0.0 for probes from other machines.",
    ),
]
LogFormatOption = Annotated[
    Literal["text", "json"],
    typer.Option(metavar="FORMAT", help="Logs as text, or as json: one object a line, for programs."),
]
Rank = Annotated[
    int,
    typer.Option(
        min=0,
        max=HIGHEST_RANK,
        help="0 leads; 1 stands by and takes over when it is dead; and so on (`standbys`).",
    ),
]


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """Replaces each parameter of a dataclass type by the fields of that class, which typer reads as options."""
    groups: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        group = parameter.annotation
        if not is_dataclass(group):
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        groups[parameter.name] = group
        hints = get_type_hints(group, include_extras=True)
        parameters += [
            inspect.Parameter(
                field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name]
            )
            for field in fields(group)
        ]

    def run(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in fields(group)})
        command(**values)

    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def _certificate(help: str) -> Any:
    return typer.Option(help=help, rich_help_panel=panels.CERTIFICATES)


@dataclass(frozen=True)
class Tls:
    """The three files of mutual TLS: all, or none."""

    tls_ca: Annotated[str | None, _certificate("Certificate of the authority, PEM.")] = None
    tls_cert: Annotated[str | None, _certificate("Our certificate, PEM.")] = None
    tls_key: Annotated[str | None, _certificate("Our private key, PEM.")] = None

    def config(self) -> TlsConfig | None:
        from launch_scripts.launcher.options import tls_of

        return tls_of(self.tls_ca, self.tls_cert, self.tls_key)


@dataclass(frozen=True)
class RunOptions:
    """How a run is started and shown: `swarm demo` and `swarm up`."""

    seconds: Annotated[
        float | None,
        typer.Option(min=0.1, max=MOST_SECONDS, help="How long the run lasts once the swarm is up."),
    ] = None
    seed: Annotated[int | None, typer.Option(min=0, max=2**53, help="Seed of everything random.")] = None
    runs: Runs = Path("runs")
    port: PortOption = None
    no_live: Annotated[
        bool, typer.Option("--no-live", help="Serve no live view. The run is recorded all the same.")
    ] = False
    record_inputs: Annotated[
        bool,
        typer.Option(
            "--record-inputs", help="Record what every process hears, so that `swarm replay` can repeat it."
        ),
    ] = False
    metrics_port: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, help="Serve figures to Prometheus, and health to probes, on this port; 0 picks one."
        ),
    ] = None
    signals_address: SignalsAddress = "127.0.0.1"
    log_format: LogFormatOption = "text"
    follow: Annotated[
        str | None,
        typer.Option(metavar="ID", help="The camera follows this vehicle or target, as a0-07."),
    ] = None
    plain: Annotated[bool, typer.Option("--plain", help="Plain lines instead of the live table.")] = False
    as_json: AsJson = False
