"""`swarm deploy`: certificates, and zenohd's configuration, for several machines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from launch_scripts.commands.shared_options import Namespace, Tls, spread
from swarm.errors import ConfigError, StoreError

app = typer.Typer(help="Certificates and configurations for a swarm on several machines.", no_args_is_help=True)


@app.command()
def certs(
    folder: Annotated[Path, typer.Argument(help="Folder of the authority and of all certificates.")],
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME[=HOST,...]...",
            help="Names to make certificates for. A router needs the hosts that others connect to.",
        ),
    ],
    days: Annotated[int, typer.Option(min=1, max=3650, help="Days until they expire.")] = 365,
    renew: Annotated[bool, typer.Option(help="Replace existing certificates.")] = False,
) -> None:
    """Make certificates for mutual TLS, signed by the folder's own authority, which is made if missing.

    swarm deploy certs certs router=10.0.0.1,base.local car1 car2

    On the router's machine, with the three files as --tls-ca, --tls-cert and --tls-key:

    swarm router my.toml --listen tls/0.0.0.0:7447 --tls-ca ca.pem --tls-cert router.pem --tls-key router.key

    On another:

    swarm agent my.toml --id a0 --connect tls/10.0.0.1:7447 --tls-ca ca.pem --tls-cert car1.pem --tls-key car1.key

    Copy ca.pem and its own two files to each machine. ca.key stays where it is: who has it can let anybody in.
    """
    from launch_scripts.deploy.certificates import issue

    for each in names:
        name, _, hosts = each.partition("=")
        path = issue(folder, name, [host for host in hosts.split(",") if host], days, renew=renew)
        print(f"{path}, {path.with_suffix('.key')}: good for {days} days")
    print(f"authority: {folder / 'ca.pem'}; keep {folder / 'ca.key'} to yourself")


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
    trust: Annotated[
        list[str] | None,
        typer.Option(help="Name of a certificate which allows everything in the namespace."),
    ] = None,
    agent: Annotated[
        list[str] | None,
        typer.Option(
            help="Agent, as GROUP.ID (all.a0), with a certificate of that name: writes only what is its own."
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

    from launch_scripts.deploy.zenohd import zenohd_config
    from launch_scripts.launcher.options import with_network
    from swarm.config.load import check_endpoint
    from swarm.config.scenario import Scenario

    if (trust or agent) and tls.tls_ca is None:
        raise ConfigError(
            "--trust and --agent go by the names in certificates: give --tls-ca, --tls-cert, --tls-key"
        )
    network = with_network(Scenario(), namespace=namespace, tls=tls.config()).network
    for option, endpoints in (("--listen", listen), ("--peer", peer)):
        for endpoint in endpoints or ():
            check_endpoint(endpoint, network.tls is not None, option)
    network = msgspec.structs.replace(network, listen=tuple(listen or network.listen), peers=tuple(peer or ()))
    if network.tls is not None:  # zenohd may run elsewhere than here
        files = (network.tls.ca, network.tls.certificate, network.tls.key)
        ca, certificate, key = (str(Path(file).resolve()) for file in files)
        absolute = msgspec.structs.replace(network.tls, ca=ca, certificate=certificate, key=key)
        network = msgspec.structs.replace(network, tls=absolute)
    config = zenohd_config(
        network,
        trusted=trust or (),
        agents=agent or (),
        plugins=None if plugins is None else str(plugins.resolve()),
        volume=volume,
    )
    try:
        out.write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise StoreError(f"cannot write {out}: {error.strerror or error}") from error
    print(f"{out}: run `zenohd -c {out}`")
