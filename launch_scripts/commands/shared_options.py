"""Options which several commands share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import typer

from launch_scripts.command_line import complete
from launch_scripts.command_line.declaring import CERTIFICATES, NETWORK, PART, from_environment
from swarm.liveness import HIGHEST_RANK

if TYPE_CHECKING:
    from swarm.config.scenario import TlsConfig

MOST_SECONDS = 1e12
"""Bound of a duration, as in a scenario."""
MOST_SEED = 2**53
"""Bound of a seed, as in a scenario."""
HIGHEST_PORT = 65535
"""Ports of TCP are numbers of 16 bits."""

Seconds = Annotated[float | None, typer.Option(min=0.1, max=MOST_SECONDS)]
Seed = Annotated[int | None, typer.Option(min=0, max=MOST_SEED)]
TargetId = Annotated[str | None, typer.Option(autocompletion=complete.target_ids)]
GroupName = Annotated[str, typer.Option(autocompletion=complete.group_names)]
VehicleClass = Annotated[str, typer.Option("--class")]
Walk = Annotated[str | None, typer.Option(autocompletion=complete.words("swarm.config.setting_types", "Walk"))]
ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="A .toml file, or a built-in scenario such as jacksboro.",
        autocompletion=complete.scenarios,
    ),
]
Namespace = Annotated[
    str | None,
    from_environment("SWARM_NAMESPACE", help="Prefix of all keys: runs in different ones do not meet."),
]
Runs = Annotated[Path, from_environment("SWARM_RUNS", help="Folder of the runs of this machine.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output, all else on standard error.")]
PortOption = Annotated[
    int | None,
    typer.Option(
        min=0,
        max=HIGHEST_PORT - 2,
        help="Router on this port, live view on the next two; 0 picks free ones.",
    ),
]
PresetOption = Annotated[
    str | None,
    typer.Option(
        help="With a terrain file: hiker, wheeled, tracked or quadruped, as cost.preset.",
        autocompletion=complete.words("swarm.config.setting_types", "Preset"),
    ),
]
SignalsAddress = Annotated[
    str,
    typer.Option(
        metavar="ADDRESS",
        help="Address of the port of figures and health; 0.0.0.0 for other machines.",
    ),
]
LogFormatOption = Annotated[
    Literal["text", "json"],
    from_environment(
        "SWARM_LOG_FORMAT",
        metavar="FORMAT",
        help="Logs as text, or as json: one object a line, for programs.",
    ),
]
Rank = Annotated[int, typer.Option(min=0, max=HIGHEST_RANK)]


@dataclass(frozen=True)
class Tls:
    """The three files of mutual TLS: all, or none. Every option that states how a swarm is reached includes them.

    tls_dir   Folder of ca.pem, certificate and key, in place of the three files.
    tls_ca    Certificate of the authority, PEM.
    tls_cert  Our certificate, PEM.
    tls_key   Our private key, PEM.
    """

    panel: ClassVar[str | None] = CERTIFICATES
    tls_dir: Annotated[str | None, from_environment("SWARM_TLS_DIR", metavar="FOLDER")] = None
    tls_ca: str | None = None
    tls_cert: str | None = None
    tls_key: str | None = None

    def tls(self) -> TlsConfig | None:
        from launch_scripts.launcher.options import tls_of

        return tls_of(self.tls_ca, self.tls_cert, self.tls_key, self.tls_dir)


@dataclass(frozen=True)
class RunOptions:
    """Start and display of a run: `swarm demo` and `swarm up`.

    seconds        How long the run lasts once the swarm is up.
    seed           Seed of everything random.
    no_live        Serve no live view. The run is recorded all the same.
    record_inputs  Record what every process hears, so that `swarm runs replay` can repeat it.
    metrics_port   Serve figures to Prometheus, and health to probes, on this port; 0 picks one.
    follow         The camera follows this vehicle or target, as a0-07.
    plain          Plain lines instead of the live table.
    detach         Run in the background: return once the swarm is whole. `swarm down` ends it.
    """

    panel: ClassVar[str | None] = None
    seconds: Seconds = None
    seed: Seed = None
    runs: Runs = Path("runs")
    port: PortOption = None
    no_live: bool = False
    record_inputs: bool = False
    metrics_port: Annotated[int | None, typer.Option(min=0, max=HIGHEST_PORT)] = None
    signals_address: SignalsAddress = "127.0.0.1"
    log_format: LogFormatOption = "text"
    follow: Annotated[str | None, typer.Option(metavar="ID")] = None
    plain: bool = False
    detach: Annotated[bool, typer.Option("--detach", "-d")] = False
    as_json: AsJson = False


@dataclass(frozen=True)
class Meeting(Tls):
    """Endpoints where the processes of a launcher meet others.

    connect  Join a router that runs elsewhere, such as tcp/127.0.0.1:7447; start none here.
    listen   Further endpoint of the router, for other machines, such as tls/0.0.0.0:7448.
    """

    panel: ClassVar[str | None] = NETWORK
    connect: str | None = None
    listen: str | None = None
    namespace: Namespace = None


@dataclass(frozen=True)
class SomeProcesses:
    """Part of a swarm that a launcher starts, and its run.

    only       Start only this role or process: planner, planner.t0.r1; may be given several times.
    rank       Start planners and targets processes of this rank only; 0 leads, 1 is the first standby.
    run_id     Take part in this run; by default a new one, or the one in the namespace.
    take_over  Take over from the launcher that runs this part here, as for an upgrade.
    """

    panel: ClassVar[str | None] = PART
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE[.ID]", autocompletion=complete.words("launch_scripts.process_table", "ROLES")),
    ] = None
    rank: Annotated[int | None, typer.Option(min=0, max=HIGHEST_RANK)] = None
    run_id: str | None = None
    take_over: bool = False
