"""`swarm deploy`: a plan of all machines, certificates, zenohd's configuration, and how many machines it takes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from launch_scripts.commands.shared_options import AsJson, Force, Namespace, ScenarioArgument, Tls
from launch_scripts.deploy import certificates, machines_needed
from launch_scripts.deploy import machine_archives as archives
from launch_scripts.deploy.machine_plan import Plan, load_hosts, make_plan, plan_fields
from launch_scripts.launcher.console import columns
from launch_scripts.launcher.run_options import common_run_id, find_scenario, own_certificate, with_options
from launch_scripts.plain_text import number_of
from launch_scripts.process_table import ROLES, admitting_all, certificate_names
from launch_scripts.report.gis_formats import check_target
from launch_scripts.typer_commands import command, complete_scenarios, family_app
from swarm.bus.zenoh_config import ROUTER, bearer, common_name
from swarm.config import revocations
from swarm.config.input_files import quoted
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import anchored
from swarm.config.setting_types import MOST_PER_AGENT, MOST_TARGETS
from swarm.endpoints import check_endpoint
from swarm.errors import ConfigError
from swarm.files import write_file

app = family_app("A plan, certificates and configurations for several machines.")
Days = Annotated[int, typer.Option(min=1, max=3650)]
_IMAGE = r"[A-Za-z0-9][A-Za-z0-9_.:/-]{0,251}:[A-Za-z0-9_][A-Za-z0-9_.-]{0,123}"
"""With a tag, which "-all" may be added to: no digest."""
_MOST_SIDE = 16_384
"""Cells of a side of the largest terrain that a scenario may have (docs/reference/limits.md)."""


@command(app)
def plan(
    scenario: ScenarioArgument,
    hosts: Annotated[Path, typer.Option()],
    out: Path | None = None,
    kit: archives.KitName = "systemd",
    image: str = "",
    wheel: Path | None = None,
    days: Days = 365,
    namespace: Namespace = None,
    as_json: AsJson = False,
) -> None:
    """Assign processes to machines, and make an archive for each.

    swarm deploy plan my.toml --hosts hosts.toml --out kits

    Then, on each machine NAME with its archive: tar xzf NAME.tar.gz && sudo swarm-NAME/install

    An archive has service, scenario and certificates. Two keepers, or a process and its standby, never share a
    machine. A second plan into the same folder renews certificates that end soon, and removes archives of other
    machines.

    hosts  The machines, in TOML: see docs/operate/machines.md.
    out    Write an archive for each machine here. Default: only print the plan.
    kit    Service manager of the processes: systemd, or compose (containers).
    image  Image of the roles, NAME:TAG, for containers. Default: that of this version.
    wheel  Wheel of the swarm, which is installed from the archives.
    days   Days until new certificates expire.
    """
    from launch_scripts.check.scenario_check import check_start  # `revoke` does not wait for it

    given = find_scenario(scenario)
    chosen = msgspec.structs.replace(given, network=with_options(given.network, namespace=namespace))
    try:
        run_id = common_run_id(chosen)
        keepers = {} if out is None else archives.keepers_before(out, run_id)
        made = make_plan(chosen, load_hosts(hosts), run_id, keepers)
    except ConfigError as error:
        sentence = str(error)
        raise ConfigError(sentence if sentence.startswith(str(hosts)) else f"{hosts}: {sentence}") from error
    if image and kit == "systemd":
        raise ConfigError(f"--image: found {quoted(image)} with --kit systemd, expected none: it has no containers")
    if image and re.fullmatch(_IMAGE, image) is None:
        raise ConfigError(f"--image: found {quoted(image)}, expected NAME:TAG; the monitor's is NAME:TAG-all")
    if wheel is not None and not (wheel.suffix == ".whl" and wheel.is_file()):
        raise ConfigError(f"--wheel: found {wheel}, expected a file NAME.whl; `uv build --wheel` makes one")
    if kit != "systemd" and wheel is not None:
        raise ConfigError(f"--wheel: found {wheel} with --kit {kit}, expected none: containers have an image")
    if out is None and (image or wheel is not None):
        raise ConfigError("--image and --wheel need --out, whose archives hold them")
    check_start(chosen, joins=True, has_ground=True)
    written = [] if out is None else archives.write_kits(made, out, days, kit, image=image, wheel=wheel)
    if as_json:
        typer.echo(json.dumps({**plan_fields(made), "archives": list(map(str, written))}, indent=2))
        return
    _show(made, kit)
    for host, archive in zip(made.hosts, written, strict=True) if written else ():
        typer.echo(f"{archive}: on {host.address} `tar xzf {archive.name} && sudo swarm-{host.name}/install`")
    if out is not None:
        typer.echo(f"{out / 'certs'}: operator.0 for your own commands, and the authority; keep ca.key to yourself")


def _show(made: Plan, kit: archives.KitName) -> None:
    # One column a machine: names of processes are many and short, machines few.
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    table.add_column("")
    for host in made.hosts:
        table.add_column(Text(host.name), overflow="fold")
    rows = {
        "address": [host.address for host in made.hosts],
        **{role: [", ".join(each.id for each in host.of(role)) for host in made.hosts] for role in ROLES},
        "load": [f"{host.load:.2f} of {host.cores:g}" for host in made.hosts],
        "terrain": ["files" if host.has_files else "from a keeper" for host in made.hosts],
    }
    for label, texts in rows.items():
        table.add_row(Text(label, "dim"), *(Text(text or "-") for text in texts))
    console = Console(highlight=False)
    console.print(table)
    machines = number_of(len(made.hosts), "machine")
    without = f"survives the loss of any {made.survive} of its {machines}; the vehicles of a lost machine stop"
    what = f"the run {without if made.survive else 'needs every machine'}"
    console.print(f"run {made.run_id}: {number_of(len(made.processes), 'process')}; {what}", soft_wrap=True)
    if kit == "systemd":
        console.print(f"{made.records} records the run and writes its report", soft_wrap=True)


@command(app)
def size(
    vehicles: Annotated[int, typer.Option(min=1, max=100_000)] = 1000,
    targets: Annotated[int, typer.Option(min=1, max=MOST_TARGETS)] = 10,
    cells: Annotated[int | None, typer.Option("--map", show_default="262 for each vehicle")] = None,
    per_agent: Annotated[int, typer.Option(min=1, max=MOST_PER_AGENT)] = 200,
    tick_hz: Annotated[float, typer.Option(min=0.1, max=100)] = 5.0,
    standbys: Annotated[int, typer.Option(min=0, max=3)] = 0,
    cores: Annotated[int, typer.Option(min=1)] = 16,
    memory: Annotated[float, typer.Option(min=0.1, max=1e6)] = 64.0,
    link: Annotated[float, typer.Option(min=1, max=1e9)] = 1000.0,
    as_json: Annotated[bool, typer.Option("--json")] = False,
) -> int:
    """Estimate how many machines a swarm needs, from a table of measured swarms.

    swarm deploy size --vehicles 1000 --targets 10

    swarm deploy size --vehicles 10000 --targets 100 --cores 32 --memory 128 --link 10000

    Machines are used to 60 % of cores and memory, and links to half. Beyond the measured swarms
    (docs/design/measurement.md) the table is extrapolated.

    Exit code 1 if a process needs more than one core, which more machines cannot give.

    vehicles   Vehicles.
    targets    Targets, each with a planner.
    cells      Cells of the map.
    per_agent  Vehicles of an agent.
    tick_hz    Ticks a second of agents and planners.
    standbys   Standbys of each planner.
    cores      Cores of a machine.
    memory     Memory of a machine, GB.
    link       Link of a machine, Mbit/s.
    as_json    Print one JSON object instead of tables.
    """
    least = max(machines_needed.LEAST_SIDE**2, 4 * vehicles)
    if cells is not None and not least <= cells <= _MOST_SIDE**2:
        raise ConfigError(f"--map is {cells}, expected {least} to {_MOST_SIDE**2} cells for {vehicles} vehicles")
    side, agents = machines_needed.side_of(vehicles, cells), -(-vehicles // per_agent)
    swarm = machines_needed.Swarm(vehicles=vehicles, targets=targets, agents=agents, side=side, tick_hz=tick_hz)
    machine = machines_needed.Machine(cores, memory, link)
    found = machines_needed.fewest_machines(machine, swarm, standbys)
    full = machines_needed.too_much(found, machine)
    beyond = found.machines > 1 or not machines_needed.reaches(swarm)
    if as_json:
        typer.echo(json.dumps({**msgspec.to_builtins(found), "full": full, "extrapolated": beyond}))
    else:
        table = columns("Needs of this swarm", number_of(found.machines, "machine"))
        for name, value in (
            ("cores, all machines", sum(found.cpu_cores.values())),
            *((f"  {role}", each) for role, each in found.cpu_cores.items()),
            ("cores, a machine", found.machine_cores),
            ("cores, the first", found.first_cores),
            ("memory, a machine, GB", found.memory_gb),
            ("memory, the first, GB", found.first_memory_gb),
            ("link of a machine, in, Mbit/s", found.link_mbit_per_s),
            ("link of the first, in, Mbit/s", found.first_link_mbit_per_s),
            ("sessions of a router", found.sessions),
        ):
            table.add_row(name, f"{value:,.3g}" if value < 100 else f"{value:,.0f}")
        Console(highlight=False).print(table)
        for each in full:
            typer.echo(f"{each}: more machines do not help.")
        if beyond:
            typer.echo("Extrapolated: larger than the swarms that were measured.")
    return int(bool(full))


@command(app)
def certs(
    folder: Path,
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME[=HOST,...]...]")] = None,
    scenario: Annotated[str | None, typer.Option(autocompletion=complete_scenarios)] = None,
    days: Days = 365,
    renew: bool = False,
) -> None:
    """Make certificates for mutual TLS, and their authority if it is missing.

    swarm deploy certs certs --scenario my.toml router.0=10.0.0.1,base.local

    This makes one per process of the scenario, named ROLE.ID, or agent.GROUP.ID, with the rights of that name
    (docs/operate/access.md). ca.key stays here: its holder can admit any process. Existing certificates are kept
    while more than a third of their validity is left.

    folder    Folder of the authority and of all certificates.
    names     Names of certificates. A router needs the hosts that others connect to.
    scenario  Also make the certificates of its processes that are missing, expire soon or are revoked.
    days      Days until they expire.
    renew     Replace existing certificates of the names given.
    """
    chosen = Scenario() if scenario is None else find_scenario(scenario)
    given = {name: hosts for name, _, hosts in (each.partition("=") for each in names or ())}
    wanted = [*given, *(() if scenario is None else certificate_names(chosen))]
    if not wanted:
        raise ConfigError("found no NAME and no --scenario, expected one: they say whose certificates to make")
    for name in wanted:
        bearer(name)
    revoked = {*chosen.network.revoked, *revocations.revoked_in(folder)}
    for name in dict.fromkeys(wanted):
        path, called = folder / f"{name}.pem", common_name(name, revoked)
        hosts = [host for host in given.get(name, "").split(",") if host]
        if bearer(name).role == ROUTER:
            hosts += certificates.THIS_MACHINE
        if name not in given and path.exists():
            if certificates.may_stay(path, (), called):
                continue
            hosts = sorted(certificates.hosts_of(path))
        certificates.issue(folder, name, hosts, days, renew=renew or name not in given, called=called)
        print(f"{path}, {path.with_suffix('.key')}: {called}, good until {certificates.ends_on(path)}")
    print(f"authority: {folder / 'ca.pem'}; keep {folder / 'ca.key'} to yourself")


@command(app)
def revoke(folder: Path, names: list[str]) -> None:
    """Revoke certificates by name. A running router notices within a second.

    swarm deploy revoke certs agent.all.a0

    This adds the names to the file `revoked` in the folder. Do the same on each machine with a router, or copy the
    file. All links drop and return at once, those of revoked names without rights. `swarm deploy certs --renew`
    makes the next certificate of a name.

    folder  Folder with the certificate of a router.
    names   Names as in the certificates: agent.all.a0~2.
    """
    path = revocations.revoke(folder, names)
    print(f"revoked, as {path} says: {', '.join(names)}")


@command(app)
def zenohd(
    out: Annotated[Path, typer.Option()],
    tls: Tls,
    listen: list[str] | None = None,
    peer: list[str] | None = None,
    namespace: Namespace = None,
    scenario: Annotated[str | None, typer.Option(autocompletion=complete_scenarios)] = None,
    plugins: Path | None = None,
    force: Force = False,
) -> None:
    """Write a configuration for zenohd as the router of a swarm.

    swarm deploy zenohd --out router.json5 --listen tcp/127.0.0.1:7447 --plugins /usr/lib/zenoh

    out       The file to write, for `zenohd -c FILE`.
    listen    Endpoint to listen at, such as tls/0.0.0.0:7447; repeat for several.
    peer      Another router to connect to.
    scenario  Scenario whose processes may take part: needed with certificates.
    plugins   Folder with libzenoh_plugin_storage_manager.so, to store marks, too.
    """
    check_target(out, "--out", force=force)
    if scenario is None and tls.tls_ca is not None:
        raise ConfigError("certificates are for access control, by the names of a scenario's processes: --scenario")
    chosen = Scenario() if scenario is None else admitting_all(find_scenario(scenario))
    network = with_options(chosen.network, namespace=namespace, tls=tls.tls())
    for option, endpoints in (("--listen", listen), ("--peer", peer)):
        for endpoint in endpoints or ():
            check_endpoint(endpoint, network.tls is not None, option)
    network = msgspec.structs.replace(
        network,
        listen=tuple(listen or network.listen),
        peers=tuple(peer or network.peers),
        tls=own_certificate(network.tls, "router.0"),
    )
    # zenohd may run elsewhere than here.
    network = anchored(msgspec.structs.replace(chosen, network=network), Path.cwd()).network
    folder = None if plugins is None else str(plugins.resolve())
    config = archives.zenohd_config(revocations.with_revocations(network), folder)
    write_file(out, (json.dumps(config, indent=2) + "\n").encode())
    print(f"{out}: run `zenohd -c {out}`")
