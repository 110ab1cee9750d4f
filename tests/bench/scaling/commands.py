"""`./launch_scripts/bench scaling`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from bench.options import AsJson, Picture, check_picture, names_of
from bench.show import show
from swarm.errors import ConfigError

app = typer.Typer()


@app.command()
def scaling(
    kinds: Annotated[
        str, typer.Option(help="What to measure: simulated, live; several with commas; none to fit only.")
    ] = "simulated,live",
    rows: Annotated[
        Path | None,
        typer.Option(help="Folder of the measurements.", show_default="that of the project"),
    ] = None,
    limit: Annotated[float, typer.Option(min=0, help="Seconds after which no measurement is begun.")] = 840.0,
    write: Annotated[
        Path | None, typer.Option(help="Write the tables into this page (.md), between its marks.")
    ] = None,
    picture: Picture = None,
    as_json: AsJson = False,
) -> None:
    """What any swarm would need: a cost model, fitted to simulations and live runs, and how wrong it is.

    \b
    bench scaling --kinds none                                       # the model of the project's measurements
    ./launch_scripts/bench scaling --rows here                                        # measured on this machine
    ./launch_scripts/bench scaling --write docs/scaling.md --picture docs/images/scaling.png

    Measures what the folder does not have yet, each kept as soon as it is there: what is interrupted goes on.
    Messages are counted in simulations, CPU and memory are those of live swarms. Some of the runs are never
    fitted to; the model is checked against them. `swarm deploy size` asks the model.

    Exit code 1 if something could not be measured.
    """
    from bench.scaling import page
    from bench.scaling.blocks import NAMES, blocks
    from bench.scaling.check import compare, model_of, usable
    from bench.scaling.design import KINDS, runs
    from bench.scaling.rows import MEASURED, measure_missing, read_rows
    from bench.whole_swarm.commands import ending_in_order

    wanted = () if kinds == "none" else names_of(kinds, "kinds", KINDS)
    folder = rows or MEASURED
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--rows is {folder}, expected a folder")
    check_picture(picture)
    if write is not None:
        page.check(write, NAMES)
    missing: list[str] = []
    with ending_in_order():
        some = [run for run in runs() if run.kind in wanted]
        missing = measure_missing(some, folder, limit, lambda text: typer.echo(text, err=True))
    used, left = usable(read_rows(folder))
    model, compared = model_of(used), compare(used)
    found = blocks(model, compared, used)
    remarks = [f"not used: {each}" for each in left] + [f"not measured: {each}" for each in missing]

    def tables(_: dict[str, Any]) -> Iterator[Table | str]:
        from bench.tables import table

        for block in found:
            if block.wide:
                continue
            shown = table(block.title, f"<{block.headings[0]}", *block.headings[1:])
            for line in block.rows:
                shown.add_row(*line)
            yield shown
            yield from block.remarks
        yield f"Too wide for here: {', '.join(block.name for block in found if block.wide)}; see docs/scaling.md."
        yield from remarks

    report = {
        "cpu_ms_per_s": {role: dict(fitted.coefficients) for role, fitted in model.cpu.items()},
        "memory_mb": {role: dict(fitted.coefficients) for role, fitted in model.memory.items()},
        "errors": [
            {
                "run": each.run,
                "figure": each.figure,
                "measured": each.measured,
                "said": each.said,
                "held_out": each.held_out,
            }
            for each in compared
        ],
        "remarks": remarks,
    }
    show(report, as_json, tables)
    if write is not None:
        page.write(write, found)
    if picture is not None:
        from bench.scaling.picture import save_picture

        save_picture(model, compared, used, picture)
    if missing:
        raise typer.Exit(1)
