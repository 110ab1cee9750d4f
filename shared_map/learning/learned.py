"""What has been learned of each kind of ground, for people: a table of the words that a store or a run holds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from shared_map.arrays import Floats
from shared_map.learning.factors import SLOPE_BINS, by_process, estimate, factors_of, name_of
from shared_map.learning.words import ONE, Said, told
from shared_map.terrain.layers import TerrainClass
from swarm.wire.messages.map_data import MarkSet


class LearnedKind(NamedTuple):
    """What is known of one kind of ground.

    kind            its class and its slopes in degrees, such as `forest 10-15`
    cells           driven cells, as all authors say together
    authors         processes that have driven there
    measured        driven over prior pace, geometric mean of what counts
    standard_error  of ln(measured)
    factor          what the prior pace is multiplied by
    """

    kind: str
    cells: int
    authors: int
    measured: float
    standard_error: float
    factor: float


def factors_in(words: Iterable[MarkSet]) -> Floats:
    """What to multiply the prior pace of each kind of ground by: float32 (KEYS,).

    words  as of `learned_kinds`
    """
    return factors_of(_voices(words))


def _voices(words: Iterable[MarkSet]) -> list[Mapping[int, Said]]:
    return by_process([(each.author, said) for each in words if (said := told(each))])


def learned_kinds(words: Iterable[MarkSet]) -> list[LearnedKind]:
    """Each kind of ground that was driven, in order of class and slope.

    words  sets about the tile beyond the map; what is no word is left out
    """
    voices = _voices(words)
    factors = factors_of(voices)
    known = range(SLOPE_BINS * (max(TerrainClass) + 1))
    by_key: dict[int, list[Said]] = {}
    for voice in voices:
        for key, said in voice.items():
            if key in known:
                by_key.setdefault(key, []).append(said)
    rows = []
    for key, parts in sorted(by_key.items()):
        together = estimate(parts)
        rows.append(
            LearnedKind(
                name_of(key),
                sum(each.cells for each in parts),
                len(parts),
                math.exp(together.mean / ONE),
                math.sqrt(together.variance / ONE / together.cells),
                float(factors[key]),
            )
        )
    return rows
