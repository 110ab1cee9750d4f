"""`swarm deploy`: a plan of all machines, certificates, and zenohd's configuration, for several machines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from launch_scripts.command_line import complete
from launch_scripts.commands.deploy_plan import plan
from launch_scripts.commands.deploy_size import size
from launch_scripts.commands.shared_options import Namespace, Tls, spread
from swarm.errors import ConfigError, StoreError

app = typer.Typer(help="A plan, certificates and configurations for several machines.", no_args_is_help=True)
app.command("plan")(plan)
app.command("size")(size)


@app.command()
def certs(
    folder: Annotated[Path, typer.Argument(help="Folder of the authority and of all certificates.")],
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME[=HOST,...]...]",
            help="Names to make certificates for. A router needs the hosts that others connect to.",
        ),
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            help="Make those that its processes lack or that end soon, too, and number anew what it revokes.",
            autocompletion=complete.scenarios,
        ),
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=3650, help="Days until they expire.")] = 365,
    renew: Annotated[bool, typer.Option(help="Replace existing certificates of the names given.")] = False,
) -> None:
    """Make certificates for mutual TLS, signed by the folder's own authority, which is made if missing.

    swarm deploy certs certs --scenario my.toml router.0=10.0.0.1,base.local

    makes one per process of the scenario, named ROLE.ID, or agent.GROUP.ID: the router lets each do what its name
    allows. operator.0 is for the launcher and for tools. On the router's machine, and on another:

    swarm router my.toml --listen tls/0.0.0.0:7447 --tls-ca certs/ca.pem --tls-cert certs --tls-key certs

    swarm agent my.toml --id a0 --connect tls/10.0.0.1:7447 --tls-ca ca.pem --tls-cert certs --tls-key certs

    Copy ca.pem and the two files of a name to where it runs. ca.key stays here: who has it can let anybody in.
    What is there is kept while more than a third of its time is left.
    """
    from launch_scripts.deploy.certificates import THIS_MACHINE, called_of, ends_on, hosts_of, issue, may_stay
    from launch_scripts.deploy.revocations import revoked_in
    from launch_scripts.launcher.options import find_scenario
    from launch_scripts.process_table import certificate_names
    from swarm.bus.access_control import ROUTER, bearer, common_name
    from swarm.config.scenario import Scenario

    chosen = Scenario() if scenario is None else find_scenario(scenario)
    given = {name: hosts for name, _, hosts in (each.partition("=") for each in names or ())}
    wanted = [*given, *(() if scenario is None else certificate_names(chosen))]
    for name in wanted:
        bearer(name)
    revoked = {*chosen.network.revoked, *revoked_in(folder)}
    for name in dict.fromkeys(wanted):
        path, again = folder / f"{name}.pem", renew
        hosts = [host for host in given.get(name, "").split(",") if host]
        if bearer(name).role == ROUTER:
            hosts += THIS_MACHINE
        if name not in given and (again := path.exists()):
            if may_stay(path, (), called_of(path)):
                continue
            hosts = sorted(hosts_of(path))
        called = common_name(name, revoked)
        issue(folder, name, hosts, days, renew=again, called=called)
        print(f"{path}, {path.with_suffix('.key')}: {called}, good until {ends_on(path)}")
    print(f"authority: {folder / 'ca.pem'}; keep {folder / 'ca.key'} to yourself")


@app.command()
def revoke(
    folder: Annotated[Path, typer.Argument(help="Folder with the certificate of a router.")],
    names: Annotated[list[str], typer.Argument(help="Names as they stand in the certificates: agent.all.a0~2.")],
) -> None:
    """Deny everything to who has these names in a certificate. A running router notices within a second.

    swarm deploy revoke certs agent.all.a0

    adds them to the file `revoked` in the folder. Do so, or copy the file, on every machine with a router. All
    links of the router end, and are back at once, those of the names with no rights. `swarm deploy certs --renew`
    makes the next certificate of a name.
    """
    from launch_scripts.deploy.revocations import revoke as add

    path = add(folder, names)
    print(f"revoked, as {path} says: {', '.join(names)}")


@app.command()
@spread
def zenohd(
    out: Annotated[Path, typer.Argument(help="The file to write, for `zenohd -c FILE`.")],
    tls: Tls,
    listen: Annotated[
        list[str] | None, typer.Option(help="Where to listen, such as tls/0.0.0.0:7447; several times if need be.")
    ] = None,
    peer: Annotated[list[str] | None, typer.Option(help="Another router to connect to.")] = None,
    namespace: Namespace = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            help="Whose processes may take part: needed with certificates.", autocompletion=complete.scenarios
        ),
    ] = None,
    plugins: Annotated[
        Path | None, typer.Option(help="Folder with libzenoh_plugin_storage_manager.so, to store marks, too.")
    ] = None,
    volume: Annotated[
        str, typer.Option(help="Volume of the storage: memory, or one whose backend is installed.")
    ] = "memory",
) -> None:
    """Write a configuration for zenohd as the router of a swarm, with its marks in zenohd's own storages.

    swarm deploy zenohd router.json5 --listen tcp/127.0.0.1:7447 --plugins /usr/lib/zenoh
    """
    import msgspec

    from launch_scripts.deploy.revocations import with_revocations
    from launch_scripts.deploy.service_files import zenohd_config
    from launch_scripts.launcher.options import find_scenario, own_certificate, with_network
    from launch_scripts.process_table import admitting_all
    from swarm.config.load import check_endpoint
    from swarm.config.scenario import Scenario

    if scenario is None and tls.tls_ca is not None:
        raise ConfigError("certificates are for access control, by the names of a scenario's processes: --scenario")
    chosen = Scenario() if scenario is None else admitting_all(find_scenario(scenario))
    network = with_network(chosen, namespace=namespace, tls=tls.config()).network
    for option, endpoints in (("--listen", listen), ("--peer", peer)):
        for endpoint in endpoints or ():
            check_endpoint(endpoint, network.tls is not None, option)
    network = msgspec.structs.replace(
        network,
        listen=tuple(listen or network.listen),
        peers=tuple(peer or network.peers),
        tls=own_certificate(network.tls, "router.0"),
    )
    network = with_revocations(network)
    if network.tls is not None:  # zenohd may run elsewhere than here
        files = (network.tls.ca, network.tls.certificate, network.tls.key)
        ca, certificate, key = (str(Path(file).resolve()) for file in files)
        absolute = msgspec.structs.replace(network.tls, ca=ca, certificate=certificate, key=key)
        network = msgspec.structs.replace(network, tls=absolute)
    config = zenohd_config(
        network,
        plugins=None if plugins is None else str(plugins.resolve()),
        volume=volume,
    )
    try:
        out.write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise StoreError(f"cannot write {out}: {error.strerror or error}") from error
    print(f"{out}: run `zenohd -c {out}`")
