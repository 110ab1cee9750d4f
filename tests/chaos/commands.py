"""`./launch_scripts/bench chaos`: a live swarm under blows."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from launch_scripts.command_line import complete
from launch_scripts.command_line.panels import RUN
from launch_scripts.commands.shared_options import MOST_SECONDS, AsJson, Runs

if TYPE_CHECKING:
    from chaos.siege import SiegeOptions
    from chaos.tally import Tally

app = typer.Typer()


@app.command(rich_help_panel=RUN)
def chaos(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO",
            help="A .toml file, or the name of a built-in scenario.",
            autocompletion=complete.scenarios,
        ),
    ] = "besieged",
    seconds: Annotated[
        float | None, typer.Option(min=1, max=MOST_SECONDS, help="End after so many seconds.")
    ] = None,
    messages: Annotated[
        int | None, typer.Option(min=1, help="End once so many hostile messages have been sent.")
    ] = None,
    blow: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this: kill, hang or messages; may be given several times.",
            autocompletion=complete.words("chaos.blows", "BLOWS"),
        ),
    ] = None,
    hostile: Annotated[
        list[str] | None,
        typer.Option(
            help="Only these messages: flipped, numbers, replayed or lies; may be given several times.",
            autocompletion=complete.words("chaos.hostile", "KINDS"),
        ),
    ] = None,
    spare: Annotated[
        list[str] | None, typer.Option(help="Say nothing hostile under this topic; may be given several times.")
    ] = None,
    every: Annotated[float, typer.Option(min=1, help="Seconds from one blow to the next, at least.")] = 10.0,
    within: Annotated[
        float, typer.Option(min=0.1, help="Recovering later than so many seconds breaks a law.")
    ] = 10.0,
    seed: Annotated[int, typer.Option(min=0, max=2**53, help="Decides the blows and their order.")] = 1,
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """Start a swarm on this machine, strike it, and measure how soon it recovers.

    Processes are killed (kill -9 of one or two) or stopped for a while, and messages are said with flipped bits,
    hostile numbers, replayed, or as well-formed lies. Lasts a minute unless --seconds or --messages say more. Exit
    code 1 if a process ended by itself, vehicles did not recover in time or met, or memory grew. Leaves chaos.json
    and chaos.png in the run's folder.

    ./launch_scripts/bench chaos --seconds 60

    ./launch_scripts/bench chaos --blow kill --every 10 --seconds 3600

    ./launch_scripts/bench chaos --blow messages --messages 1000000
    """
    from chaos.blows import BLOWS
    from chaos.hostile import KINDS
    from chaos.siege import SiegeOptions
    from swarm.wire.topics import TOPICS

    if seconds is None and messages is None:
        seconds = 60.0
    options = SiegeOptions(
        scenario=scenario,
        seconds=seconds,
        messages=messages,
        seed=seed,
        every_s=every,
        kinds=check_kinds("--blow", blow, BLOWS),
        hostile=check_kinds("--hostile", hostile, KINDS),
        spared=check_kinds("--spare", spare, tuple(topic.name for topic in TOPICS)) if spare else (),
        within_s=within,
        runs=runs,
    )
    if not besiege(options, as_json):
        raise typer.Exit(1)


def besiege(options: SiegeOptions, as_json: bool) -> bool:
    """Besiege a swarm, print what came of it. True if every law held."""
    from chaos.picture import draw
    from chaos.siege import Siege
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
    from swarm.config.explain import choice
    from swarm.errors import ConfigError

    for each in given or ():
        if each not in known:
            raise ConfigError(f"{option}: no {each!r}{choice(each, known, ' there are ')}")
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
