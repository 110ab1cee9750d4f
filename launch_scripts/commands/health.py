"""`swarm health`: whether a swarm, or the processes of a machine, are ready, as an exit code."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from launch_scripts.command_line import panels
from launch_scripts.commands.query import Where, ask_status
from launch_scripts.commands.shared_options import AsJson, Tls, spread

if TYPE_CHECKING:
    from launch_scripts.commands.running.status import Status
    from launch_scripts.web.health_probe import Answer

app = typer.Typer()


@app.command(rich_help_panel=panels.ASK)
@spread
def health(
    where: Where,
    tls: Tls,
    url: Annotated[
        str | None,
        typer.Option(
            help="Ask the machine whose figures or health are served there, such as http://127.0.0.1:9464."
        ),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="With --url: whether its processes live, not whether they are ready.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Say whether a swarm is ready: exit code 0 if it is, 1 if not, 4 if nobody answers. For probes.

    With --url it asks the processes of one machine, which answer without a router; put it first, and the answer is
    there in a fraction of a second. Otherwise it asks the whole swarm over its router, for two seconds.

    swarm health --url http://127.0.0.1:9464

    swarm health --url http://127.0.0.1:9464 --live

    swarm health --connect tcp/127.0.0.1:7447 --json
    """
    from launch_scripts.web.health_probe import ask
    from swarm.errors import ConfigError

    if url is None and live:
        raise ConfigError("--live goes with --url: of a whole swarm it is asked whether it is ready")
    if url is not None and (where.connect or where.run or where.namespace or tls != Tls()):
        raise ConfigError(
            "--url asks one machine without TLS; what says how a whole swarm is reached goes without it"
        )
    answer = swarm_answer(ask_status(where, tls)) if url is None else ask(url, live=live)
    raise typer.Exit(answer.show(as_json=as_json))


def swarm_answer(status: Status) -> Answer:
    """Whether all processes that the run needs are there and ready."""
    from launch_scripts.web.health_probe import Answer
    from swarm.runtime.stats import READY

    observed = status.latest
    processes = {(role, id): observed.newest_stats(role, id) for role, id in observed.up()}
    unready = [
        f"{role}-{id}"
        for (role, id), stats in sorted(processes.items())
        if stats is not None and stats.gauges.get(READY) == 0.0
    ]
    missing = [f"{name.replace(' ', '-', 1)}: does not run" for name in observed.missing()]
    missing += [f"{name}: not ready, as it says" for name in unready]
    if not any(info.run_id for info in status.members):
        missing.append("no run: only routers answer")
    told = {
        "status": "not ready" if missing else "ready",
        "missing": missing,
        "processes": [{"name": f"{role}-{id}"} for role, id in sorted(processes)],
    }
    return Answer(not missing, told)
