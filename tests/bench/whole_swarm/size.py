"""The size of a measured swarm and its scenario: that of `thousand`, with a map which grows with the vehicles."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec

from swarm.config.scenario import Scenario
from swarm.config.scenario_files import parse_scenario
from swarm.config.setting_types import MOST_PER_AGENT, MOST_TARGETS
from swarm.errors import ConfigError
from swarm.right_of_way.shards import fitting_regions

CELLS_PER_VEHICLE = 262.144
"""The ratio of `thousand`: 512 x 512 cells for 1,000 vehicles."""
_VEHICLES_AN_AGENT = 500
_FEWEST_AGENTS, _MOST_AGENTS = 5, 40
_MOST_VEHICLES = 100_000
LEAST_SIDE, MOST_SIDE = 32, 16_384

_LIVE = "# --- of live swarms only\n"
_SCENARIO = Path(__file__).with_name("scale.toml.in")


class Size(msgspec.Struct, frozen=True, kw_only=True):
    """A swarm of one size.

    agents     processes that host the vehicles: one for each five hundred, 5 at least and 40 at most
    per_agent  vehicles of each, the last may have fewer
    side       cells a side of the square map
    shard_regions  `map.shard_regions`
    """

    vehicles: int
    targets: int
    agents: int
    per_agent: int
    side: int
    shard_regions: int = 1


def size_of(vehicles: int, targets: int = 10, side: int | None = None) -> Size:
    """The size with everything that is not given. Raises ConfigError, which names the option.

    side  by default as many cells a vehicle as `thousand` has
    """
    _between("--vehicles", vehicles, 1, _MOST_VEHICLES)
    _between("--targets", targets, 1, MOST_TARGETS)
    usual = min(max(-(-vehicles // _VEHICLES_AN_AGENT), _FEWEST_AGENTS), _MOST_AGENTS, vehicles)
    per_agent = -(-vehicles // max(usual, -(-vehicles // MOST_PER_AGENT)))
    if side is None:
        side = max(round(math.sqrt(CELLS_PER_VEHICLE * vehicles)), LEAST_SIDE)
    _between("--size", side, max(LEAST_SIDE, math.isqrt(4 * vehicles) + 1), MOST_SIDE)
    agents = -(-vehicles // per_agent)
    return Size(
        vehicles=vehicles,
        targets=targets,
        agents=agents,
        per_agent=per_agent,
        side=side,
        shard_regions=fitting_regions(side, side, agents),
    )


def scenario_text(size: Size, endpoint: str | None = None) -> str:
    """The scenario as a file. The density of features on the map stays the same: roads and rivers by length,
    obstacles by area.

    endpoint  of the router; the live view then takes free ports
    """
    lengths, areas = size.side / 512, (size.side / 512) ** 2
    scenario, _, places = _SCENARIO.read_text(encoding="utf-8").partition(_LIVE)
    text = scenario.format(
        **msgspec.structs.asdict(size),
        roads=min(max(round(24 * lengths), 2), 200),
        rivers=min(max(round(2 * lengths), 1), 50),
        closed_roads=min(round(20 * areas), 1000),
        rubble_fields=min(round(30 * areas), 10_000),
    )
    return text if endpoint is None else text + places.format(endpoint=endpoint)


def scenario_of(size: Size) -> Scenario:
    return parse_scenario(scenario_text(size))


def _between(option: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise ConfigError(f"{option} is {value}, expected {least} to {most}")
