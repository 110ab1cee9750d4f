"""Learned factors of kinds of ground: equal at every replica, bounded against lies, and never of lethal ground."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from shared_map.cost_map import CostMap
from shared_map.learned_factors import MOST_STEPS, factors_of, log_steps
from shared_map.pace_measurements import MOST, MOST_CELLS, ONE, Measured, Measurement, TrimmedMean, measurements_in
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import beyond_tile
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.vehicle_classes import MOST_CLASSES
from swarm.wire.messages.map_data import MarkSet

SAID = st.builds(
    Measurement, st.integers(1, MOST_CELLS), st.integers(-MOST, MOST), st.integers(0, MOST * MOST // ONE)
)
WORDS = st.dictionaries(st.integers(0, 255), SAID, max_size=4)
THRICE = Measurement(400, round(np.log(3) * ONE), ONE // 10)


PACE = np.full((40, 50), 0.5, np.float32)
PACE[5, 5:20] = np.inf
GROUND = terrain_of_pace(PACE)
FEW = settings(max_examples=15, deadline=None)


def replica_of(author: str | None, ground: Terrain) -> tuple[MapReplica, CostMap]:
    cost_map = CostMap(ground, learning=True)
    return MapReplica(GROUND.grid, cost_map, author=author), cost_map


def sets_of(author: str, *said: dict[int, Measurement]) -> list[MarkSet]:
    """The sets that an author publishes when it learns these, one after the other."""
    replica, _ = replica_of(author, GROUND)
    return [each for n, one in enumerate(said) for each in replica.write_learned(one, n * 10**9)]


@FEW
@given(WORDS)
def test_words_are_read_as_they_were_written(said: dict[int, Measurement]) -> None:
    (word,) = sets_of("all.a.1", said)
    word.check()
    assert measurements_in(word) == said


@given(st.lists(SAID, min_size=4, max_size=8), SAID)
def test_one_liar_among_five_moves_a_factor_no_further_than_some_honest_author(honest, lie):
    honest = [each._replace(cells=5 + each.cells % 1000) for each in honest]
    steps = log_steps([*honest, lie._replace(cells=max(lie.cells, 5))])
    alone = [round(each.mean / 6246) for each in honest]
    assert min(*alone, 0) - 1 <= steps <= max(*alone, 0) + 1


@given(st.lists(st.just(Measurement(100, 0, ONE // 10)), min_size=2, max_size=3), SAID)
def test_before_five_a_liar_has_a_bounded_share(honest: list[Measurement], lie: Measurement) -> None:
    share = 2 / (2 + len(honest))
    assert abs(log_steps([*honest, lie])) <= share * MOST_STEPS + 1


@given(st.integers(30, 400), SAID)
def test_an_author_that_has_hardly_begun_takes_nothing_from_what_another_knows(cells, said):
    few = said._replace(cells=1, mean=max(-ONE, min(ONE, said.mean)), variance=0)
    known = THRICE._replace(cells=cells)
    assert log_steps([known, few]) >= log_steps([known]) - 2


@FEW
@given(st.lists(WORDS, min_size=2, max_size=30), st.integers(0, NS_PER_S))
def test_however_often_an_author_changes_its_mind_the_map_changes_once_in_five_seconds(words, every_ns):
    replica, cost_map = replica_of(None, GROUND)
    sets = sets_of("all.a.1", *words)
    at_ns = 100 * NS_PER_S
    for each in sets:
        at_ns += every_ns
        replica.tick(at_ns)
        replica.merge([each])
    assert cost_map.version <= 1 + len(sets) * every_ns // (5 * NS_PER_S) + 1
    replica.tick(at_ns + 6 * NS_PER_S)  # what came too soon after a change is taken in, too
    assert (cost_map.factors == factors_of([words[-1]])).all()


@FEW
@given(st.dictionaries(st.integers(0, 255), SAID, max_size=30))
def test_factors_lie_within_a_quarter_and_four(said: dict[int, Measurement]) -> None:
    factors = factors_of([said])
    assert (factors >= 0.25).all()
    assert (factors <= 4).all()


def test_what_is_no_word_changes_nothing() -> None:
    (word,) = sets_of("all.a.1", {0: THRICE})
    paces = np.frombuffer(word.paces, "<f4")
    wrong = [
        replace(word, paces=np.full(3, 0.5, "<f4").tobytes()),  # a negative number
        replace(word, paces=np.full(3, 99.0, "<f4").tobytes()),  # more than there can be
        replace(word, paces=(paces + np.float32(2**-18)).astype("<f4").tobytes()),  # no whole number
        replace(word, cells=np.array([1, 2, 3], "<u2").tobytes()),
        replace(word, cells=np.array([900, 901, 902], "<u2").tobytes()),
        replace(word, kinds=bytes([1, 1, 1])),
        replace(
            word, cells=word.cells[:4], kinds=word.kinds[:2], paces=word.paces[:8], stamps_ns=word.stamps_ns[:16]
        ),
    ]  # fmt: skip
    for each in wrong:
        replica, cost_map = replica_of(None, GROUND)
        each.check()
        replica.merge([each])
        assert measurements_in(each) is None
        assert (cost_map.factors == 1).all()
    with pytest.raises(ValueError, match="pace"):
        replace(word, paces=np.full(3, np.nan, "<f4").tobytes()).check()


def test_a_process_has_one_voice_however_many_generations_it_writes_under() -> None:
    right, lie = {0: Measurement(400, 0, ONE // 10)}, {0: THRICE}
    honest = [each for n in range(5) for each in sets_of(f"all.a{n}.1", right)]
    replica, cost_map = replica_of(None, GROUND)
    replica.merge([*honest, *(each for n in range(9) for each in sets_of(f"all.liar.{n}", lie))])
    assert (cost_map.factors == 1).all()


def test_operators_do_not_learn_and_no_set_lies_further_beyond() -> None:
    (word,) = sets_of("all.a.1", {0: THRICE})
    replica, cost_map = replica_of(None, GROUND)
    assert word.tile == beyond_tile(cost_map.grid)
    beyond_all = (MOST_CLASSES + 1) * (word.tile + 1)
    replica.merge([replace(word, tile=beyond_all), replace(word, author="operator.z1", group="operator")])
    assert replica.counts["sets_refused"] == 2
    assert (cost_map.factors == 1).all()


def test_a_cell_counts_once_and_what_is_no_pace_not_at_all() -> None:
    measured = Measured(np.zeros((4, 4), np.uint8))
    for cell, driven, prior in ((1, 1.5, 0.5), (1, 9.0, 0.5), (2, np.nan, 0.5), (3, 1.0, np.inf), (4, 0.0, 1.0)):
        measured.add(cell, driven, prior)
    assert measured.by_key == {0: Measurement(1, round(np.log(3) * ONE), 0)}


def test_a_slope_of_which_too_little_counts_has_the_factor_of_its_class() -> None:
    level, steep = 0, 3
    words = [{level: THRICE, steep: THRICE._replace(cells=4)}, {level: THRICE, steep: THRICE._replace(cells=1)}]
    factors = factors_of(words)
    assert factors[steep] == factors[level] > 2.5
    assert factors_of([words[0], {steep: Measurement(100, 0, ONE // 10)}])[steep] == 1, (
        "it is known to be as the prior says"
    )


@pytest.mark.parametrize("cells", [4, 5, 20, 400])
def test_only_what_is_significant_is_learned(cells: int) -> None:
    assert (log_steps([Measurement(cells, THRICE.mean, ONE // 10)]) > 8) == (cells >= 5)
    assert log_steps([Measurement(cells, ONE // 20, ONE // 10)]) == 0


@given(st.lists(st.integers(-MOST, MOST), min_size=1, max_size=80))
def test_the_middle_half_is_that_of_the_sorted_numbers_in_whatever_order_they_come(numbers: list[int]) -> None:
    middle, other = TrimmedMean(), TrimmedMean()
    for y, another in zip(numbers, sorted(numbers), strict=True):
        middle.add(y)
        other.add(another)
    assert middle.measurement == other.measurement
    cut = len(numbers) // 4
    kept = sorted(numbers)[cut : len(numbers) - cut]
    assert abs(middle.measurement.mean - sum(kept) / len(kept)) <= ONE // 64 + 1
    held = np.clip(np.sort(np.array(numbers, np.float64)), kept[0], kept[-1]) / ONE
    variance = min(held.var() * (len(numbers) / len(kept)) ** 2, 25.0)
    assert middle.measurement.variance / ONE == pytest.approx(variance, rel=0.02, abs=0.05)
