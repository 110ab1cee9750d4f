"""`swarm chaos`: a live swarm under blows."""

from __future__ import annotations

import json
import signal
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from launch_scripts.chaos.siege import SiegeOptions
    from launch_scripts.chaos.tally import Tally


def chaos(options: SiegeOptions, as_json: bool) -> bool:
    """Besiege a swarm, print what came of it. True if every law held."""
    from launch_scripts.chaos.picture import draw
    from launch_scripts.chaos.siege import Siege
    from swarm.errors import StoreError

    # As an exception, the end passes every `finally`, and with it the end of the swarm.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    siege = Siege(options, lambda text: typer.echo(text, err=True))
    typer.echo(f"logs, chaos.json and chaos.png in {siege.run_dir}", err=True)
    interrupted = False
    try:
        tally = siege.run()
    except KeyboardInterrupt:
        tally, interrupted = siege.tally, True
        typer.echo("interrupted: the figures are of the part that has run", err=True)
    report = tally.report()
    try:
        (siege.run_dir / "chaos.json").write_text(json.dumps(report, indent=1))
    except OSError as error:
        raise StoreError(f"cannot write {siege.run_dir / 'chaos.json'}: {error.strerror or error}") from error
    draw(tally, siege.run_dir / "chaos.png")
    if as_json:
        typer.echo(json.dumps({name: value for name, value in report.items() if name != "samples"}, indent=2))
    else:
        _print(tally, report)
    return not report["broken"] and not interrupted


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def check_kinds(option: str, given: list[str] | None, known: tuple[str, ...]) -> tuple[str, ...]:
    """What an option that may be given several times names; all if it is not given. Raises ConfigError."""
    from swarm.errors import ConfigError

    for each in given or ():
        if each not in known:
            raise ConfigError(f"{option}: no {each!r}; there are {', '.join(known)}")
    return tuple(given or known)


def _print(tally: Tally, report: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(
        "blow", "times", "routed p50 s", "max s", "moving p50 s", "max s", "over 2 s", "never", pad_edge=False
    )
    for row in report["rows"]:
        shown = [row["kind"], str(row["blows"])]
        for name in ("routed_p50_s", "routed_max_s", "moving_p50_s", "moving_max_s"):
            shown.append("-" if row[name] is None else f"{row[name]:.2f}")
        table.add_row(*shown, str(row["slower_than_2_s"]), str(row["never"]))
    console.print(table)
    told = ", ".join(f"{many:,} {kind}" for kind, many in sorted(tally.messages.items())) or "none"
    grown = ", ".join(
        f"{name} {'-' if share is None else f'{100 * share:+.1f} %'}" for name, share in report["growth"].items()
    )
    console.print(f"{tally.seconds:.0f} s; hostile messages: {told}; growth: {grown}", highlight=False)
    for sentence in report["broken"]:
        console.print(f"broken: {sentence}", style="red", markup=False, highlight=False)
    console.print(f"{len(report['broken'])} laws broken, {len(tally.ended)} processes ended by themselves")
