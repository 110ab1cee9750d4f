"""`swarm deploy plan`: who runs on which machine, and an archive for each."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from launch_scripts.commands.shared_options import AsJson, Namespace, ScenarioArgument
from swarm.config.input_files import quoted
from swarm.errors import ConfigError

KitName = Literal["systemd", "compose"]
_IMAGE = r"[A-Za-z0-9][A-Za-z0-9_.:/-]{0,251}:[A-Za-z0-9_][A-Za-z0-9_.-]{0,123}"
"""With a tag, which "-all" may be added to: no digest."""

if TYPE_CHECKING:
    from launch_scripts.deploy.plan import Plan


def plan(
    scenario: ScenarioArgument,
    hosts: Annotated[Path, typer.Option(help="The machines, in TOML: see docs/deploy.md.")],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write an archive for each machine here, certificates included; if not given, only show."
        ),
    ] = None,
    kit: Annotated[
        KitName, typer.Option(help="What starts the processes: systemd, or compose (containers).")
    ] = "systemd",
    image: Annotated[
        str, typer.Option(help="Image of the roles, NAME:TAG, for containers; if not given, that of this version.")
    ] = "",
    wheel: Annotated[
        Path | None, typer.Option(help="Put this wheel of the swarm into the archives, to be installed from them.")
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=3650, help="Days until new certificates expire.")] = 365,
    namespace: Namespace = None,
    as_json: AsJson = False,
) -> None:
    """Say which process runs on which machine, and make an archive for each: service, scenario, certificates.

    swarm deploy plan my.toml --hosts hosts.toml --out kits

    then on each machine NAME, with its archive: tar xzf NAME.tar.gz && sudo swarm-NAME/install

    Every process runs once; keepers, and planners and their standbys, on machines of their own. A second plan into
    the same folder keeps the certificates, but for those that end soon or whose names were revoked, and removes the
    archives of machines that it does not have.
    """
    from launch_scripts.check.settings import check_start
    from launch_scripts.deploy.hosts import load_hosts
    from launch_scripts.deploy.kits import keepers_before
    from launch_scripts.deploy.plan import make_plan
    from launch_scripts.launcher.options import common_run_id, find_scenario, with_network

    chosen = with_network(find_scenario(scenario), namespace=namespace)
    try:
        run_id = common_run_id(chosen)
        keepers = {} if out is None else keepers_before(out, run_id)
        made = make_plan(chosen, load_hosts(hosts), run_id, keepers)
    except ConfigError as error:
        raise ConfigError(_of_file(str(error), hosts)) from error
    _check_image(image, kit)
    if wheel is not None and not (wheel.suffix == ".whl" and wheel.is_file()):
        raise ConfigError(f"--wheel: found {wheel}, expected a file NAME.whl; `uv build --wheel` makes one")
    if kit != "systemd" and wheel is not None:
        raise ConfigError(f"--wheel: found {wheel} with --kit {kit}, expected none: containers have an image")
    if out is None and (image or wheel is not None):
        raise ConfigError("--image and --wheel go into what --out writes, and it is not given")
    check_start(chosen, joins=True, has_ground=True)
    written = [] if out is None else _write(made, out, kit, image, days, wheel)
    if as_json:
        from launch_scripts.deploy.plan import as_json as fields

        typer.echo(json.dumps({**fields(made), "archives": list(map(str, written))}, indent=2))
        return
    _show(made, kit)
    for host, archive in zip(made.hosts, written, strict=True) if written else ():
        typer.echo(f"{archive}: on {host.address} `tar xzf {archive.name} && sudo swarm-{host.name}/install`")
    if out is not None:
        typer.echo(f"{out / 'certs'}: operator.0 for your own commands, and the authority; keep ca.key to yourself")


def _check_image(image: str, kit: KitName) -> None:
    if image and kit == "systemd":
        raise ConfigError(f"--image: found {quoted(image)} with --kit systemd, expected none: it has no containers")
    if image and re.fullmatch(_IMAGE, image) is None:
        raise ConfigError(f"--image: found {quoted(image)}, expected NAME:TAG; the monitor's is NAME:TAG-all")


def _write(made: Plan, out: Path, kit: KitName, image: str, days: int, wheel: Path | None) -> list[Path]:
    from launch_scripts.deploy.host_scenario import CERTIFICATES
    from launch_scripts.deploy.kits import write_kits
    from launch_scripts.deploy.revocations import revoked_in
    from launch_scripts.deploy.service_files import compose_files, systemd_files

    if kit == "systemd":
        return write_kits(made, out, systemd_files, days, wheel)
    compose = partial(compose_files, image=image, revoked=revoked_in(out / CERTIFICATES))
    return write_kits(made, out, compose, days, launcher=False)


def _of_file(sentence: str, path: Path) -> str:
    """A sentence that begins with the file."""
    return sentence if sentence.startswith(str(path)) else f"{path}: {sentence}"


def _show(made: Plan, kit: KitName) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from launch_scripts.deploy.plan import COLUMNS, rows

    # One column a machine: names of processes are many and short, machines few.
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    machines = rows(made)
    table.add_column("")
    for machine in machines:
        table.add_column(Text(machine[0]), overflow="fold")
    for n, column in enumerate(COLUMNS[1:], 1):
        table.add_row(Text(column, "dim"), *(Text(machine[n] or "-") for machine in machines))
    console = Console(highlight=False)
    console.print(table)
    lost = made.survive
    what = "no machine may be lost" if not lost else f"{lost} of {len(made.hosts)} machines may be lost at once"
    console.print(f"run {made.run_id}: {len(made.processes)} processes; {what}", soft_wrap=True)
    if kit == "systemd":
        console.print(f"{made.records} records the run and writes its report", soft_wrap=True)
