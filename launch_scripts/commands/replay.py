"""`swarm replay`: what a run's processes heard, fed to the services of this build."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path
from typing import Any

import typer

from launch_scripts.launcher.console import progress
from launch_scripts.observe.run_folder import find_run
from launch_scripts.plain_text import plain
from launch_scripts.replay.run import Replayed, keep, other_versions, recordings_of, replay_run, unreadable
from swarm.recording.replaying import Difference

_ROW = "{:<22} {:>4} {:>9} {:>9} {:>9}  {}"
_SHOWN = 300
"""Characters of an output."""


def replay_one(
    name: str, runs: Path, process: str | None, until_s: float | None, keep_in: Path | None, as_json: bool
) -> bool:
    """Replay a run, and print where outputs differ. True if none does. Raises SwarmError."""
    logging.getLogger().addHandler(logging.NullHandler())  # what the processes logged is in their own logs
    folder = find_run(name, runs)
    if keep_in is not None:
        for recorded in recordings_of(folder, process):
            typer.echo(f"kept {keep(recorded, keep_in, until_s)}", err=as_json)
        folder = keep_in
    refused = unreadable(folder, process)
    others: dict[str, tuple[str, str]] = {}
    for recorded in recordings_of(folder, process):
        others |= other_versions(recorded)
    if not as_json:
        for package, (then, now) in others.items():
            typer.echo(f"recorded with {package} {then}, replayed with {now}")
        typer.echo(_ROW.format("process", "life", "events", "outputs", "seconds", "result"))
    rows: list[Replayed] = []
    with progress() as tell:
        for row in replay_run(folder, process, until_s, progress=lambda share: tell("replaying", share)):
            rows.append(row)
            if not as_json:
                typer.echo(_line(row))
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "run": str(folder),
                    "versions": others,
                    "processes": list(map(_told, rows)),
                    "unreadable": refused,
                },
                indent=2,
            )
        )
    else:
        _explain(rows)
        for sentence in refused:
            typer.echo(plain(sentence))
    return not refused and all(row.same for row in rows)


def _line(row: Replayed) -> str:
    recorded, outcome = row.recorded, row.outcome
    if outcome is None:
        return _ROW.format(recorded.process, recorded.life, "-", "-", "-", "not replayed")
    if outcome.difference is not None:
        result = f"differs at event {outcome.difference.event:,}"
    elif outcome.damaged is not None:
        result = "damaged; same until there"
    else:
        result = "same" if outcome.ended == "ended as asked" else f"same ({outcome.ended})"
    figures = (f"{outcome.events:,}", f"{outcome.outputs:,}", f"{outcome.seconds:.2f}")
    return _ROW.format(recorded.process, recorded.life, *figures, plain(result))


def _explain(rows: list[Replayed]) -> None:
    for row in rows:
        who = f"{row.recorded.process}, life {row.recorded.life}"
        if row.outcome is None:
            typer.echo(plain(f"{who}: {row.why}"))
        elif row.outcome.difference is not None:
            _show(who, row.outcome.difference)
        elif row.outcome.damaged is not None:
            typer.echo(plain(f"{who}: {row.recorded.path} is {row.outcome.damaged}"))
    outcomes = [row.outcome for row in rows if row.outcome is not None]
    same = sum(row.same for row in rows)
    typer.echo(
        f"{sum(each.events for each in outcomes):,} events, {sum(each.outputs for each in outcomes):,} outputs: "
        f"{same} of {len(rows)} recordings give the same"
    )


def _show(who: str, difference: Difference) -> None:
    typer.echo(plain(f"{who}: event {difference.event:,}, {difference.what}, at {difference.seconds:.2f} s"))
    typer.echo(f"    recorded: {_short(difference.recorded)}")
    typer.echo(f"    replayed: {_short(difference.replayed)}")


def _short(output: str | None) -> str:
    if output is None:
        return "nothing more"
    return plain(output) if len(output) <= _SHOWN else f"{plain(output[:_SHOWN])} ..."


def _told(row: Replayed) -> dict[str, Any]:
    recorded = row.recorded
    return {
        "process": recorded.process,
        "life": recorded.life,
        "incarnation": recorded.head.incarnation,
        "bytes": recorded.bytes,
        "same": row.same,
        "why": row.why,
        **({} if row.outcome is None else dataclasses.asdict(row.outcome)),
    }
