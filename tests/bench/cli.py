"""`swarm bench`: one command per measurement. With --json one object on standard output; progress on stderr."""

from __future__ import annotations

from typing import Annotated

import typer
from chaos import commands as chaos

from bench.options import AsJson, Seed, names_of, numbers_of
from bench.planning import commands as planning
from bench.scaling import commands as scaling
from bench.show import progress_of, show
from bench.whole_swarm import commands as whole_swarm

app = typer.Typer(
    name="bench",
    help="Measure: trees beside other libraries, the paper's tables, scale, gaps, terrain, the wire, whole swarms.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.add_typer(planning.app)


@app.command()
def terrain(
    size: Annotated[int, typer.Option(min=64, help="Cells a side.")] = 4096,
    repeats: Annotated[int, typer.Option(min=1, help="Interleaved runs of each pass.")] = 3,
    degrees: Annotated[bool, typer.Option("--degrees", help="Files in degrees, which have to be warped.")] = False,
    as_json: AsJson = False,
) -> None:
    """Elevation and photo to cost: seconds and memory, beside a plain pass.

    ./launch_scripts/bench terrain --json
    """
    from bench.terrain import run

    with progress_of("terrain") as progress:
        report = run(size, repeats, degrees=degrees, progress=progress)
    show(report, as_json)


@app.command()
def wire(
    parts: Annotated[
        str, typer.Option(help="latency, throughput, join, route, positions, replica, codec; several with commas.")
    ] = "latency,throughput,join,route,positions,replica,codec",
    marks: Annotated[int, typer.Option(min=10, help="latency: marks, and as many raw puts.")] = 400,
    sets: Annotated[int, typer.Option(min=100, help="throughput: sets in a round.")] = 20_000,
    rounds: Annotated[int, typer.Option(min=1, help="throughput: rounds of ours and raw, in turn.")] = 3,
    joins: Annotated[int, typer.Option(min=1, help="join: newcomers, one after the other.")] = 7,
    queries: Annotated[int, typer.Option(min=10, help="route: queries, and as many raw ones.")] = 300,
    seconds: Annotated[float, typer.Option(min=1, help="positions: how long, ours and raw each.")] = 5.0,
    as_json: AsJson = False,
) -> None:
    """The shared map, route queries and positions over real Zenoh, beside raw Zenoh. Half a minute.

    \b
    ./launch_scripts/bench wire
    ./launch_scripts/bench wire --parts latency,throughput --marks 2000 --json

    A router and the processes that receive and answer are started on free ports of this machine and ended. Ours and
    raw take turns, with the same bytes under keys of the same form: on a busy machine look at the ratios.
    """
    from bench.wire.overview import PARTS, run, tables

    chosen = names_of(parts, "parts", PARTS)
    with progress_of("wire") as progress:
        report = run(
            chosen,
            marks=marks,
            sets=sets,
            rounds=rounds,
            joins=joins,
            queries=queries,
            seconds=seconds,
            progress=progress,
        )
    show(report, as_json, tables)


@app.command("ros2-gateway")
def ros2_gateway(
    vehicles: Annotated[int, typer.Option(min=25, help="A multiple of 25.")] = 100,
    seconds: Annotated[float, typer.Option(min=1, help="How long.")] = 20.0,
    as_json: AsJson = False,
) -> None:
    """CPU that `swarm ros2` takes for many vehicles, each at 10 Hz, with plans, map and markers.

    \b
    ./launch_scripts/bench ros2-gateway --vehicles 100
    """
    from bench.wire.ros2_gateway import run

    with progress_of("ros2-gateway") as progress:
        report = run(vehicles, seconds, progress)
    show(report, as_json)


@app.command()
def ros2(
    questions: Annotated[int, typer.Option(min=10, help="Questions and goals of each kind.")] = 200,
    seconds: Annotated[float, typer.Option(min=1, help="How long ROS floods, and is quiet, in each round.")] = 4.0,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of flood and quiet.")] = 5,
    hz: Annotated[int, typer.Option(min=100, help="Messages a second of the flood.")] = 5000,
    as_json: AsJson = False,
) -> None:
    """Plans for clients of ROS beside the swarm's own queries, and those while ROS floods the gateway. A minute.

    \b
    ./launch_scripts/bench ros2

    Two routers, three planners of 512 x 512 cells, the gateway's part and the flood are processes of their own on
    this machine. ROS and the swarm's own take turns: look at the ratios.
    """
    from bench.wire.ros2 import run, tables

    with progress_of("ros2") as progress:
        report = run(questions, seconds, rounds, hz, progress)
    show(report, as_json, tables)


@app.command()
def compaction(
    lives: Annotated[int, typer.Option(min=1, help="Lives of one agent, each with 100 writes.")] = 200,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """Size of a keeper's store after many lives of an agent, with and without compaction of dead authors.

    \b
    ./launch_scripts/bench compaction --lives 1000
    """
    from bench.wire.compaction import run

    with progress_of("compaction") as progress:
        report = run(lives, seed, progress)
    show(report, as_json)


@app.command()
def partition(
    rounds: Annotated[int, typer.Option(min=1, help="Partitions, one after the other.")] = 20,
    seconds: Annotated[float, typer.Option(min=0.1, help="How long each lasts, with writes on both sides.")] = 30.0,
    as_json: AsJson = False,
) -> None:
    """How soon all replicas are equal after a partition heals. Needs root and iproute2; some eleven minutes.

    \b
    ./launch_scripts/bench partition --rounds 2 --seconds 5

    Two network namespaces stand for two machines, each with a router, a keeper,
    two authors and a listener; they meet over mutual TLS.
    """
    from bench.wire.partition import run

    with progress_of("partition") as progress:
        report = run(rounds, seconds, progress)
    show(report, as_json)


@app.command()
def presence(
    vehicles: Annotated[str, typer.Option(help="Numbers of vehicles, multiples of 25.")] = "1000,5000",
    rounds: Annotated[int, typer.Option(min=1, help="Ticks; the median counts.")] = 50,
    as_json: AsJson = False,
) -> None:
    """CPU time per tick that an agent spends on the positions of all other vehicles.

    \b
    ./launch_scripts/bench presence --vehicles 10000
    """
    from bench.wire.presence import run

    with progress_of("presence") as progress:
        report = run(numbers_of(vehicles, "vehicles", 25), rounds, progress)
    show(report, as_json)


app.add_typer(whole_swarm.app)
app.add_typer(scaling.app)
app.add_typer(chaos.app)
