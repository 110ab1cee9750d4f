"""The book of orders: the newest about each subject, whatever the order of arrival; what cannot be is refused."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarm.config.scenario import plan_agents
from swarm.config.scenario_files import parse_scenario
from swarm.runtime.order_book import (
    FRESH_NS,
    MAX_AHEAD_NS,
    MOST_ORDERS,
    SETTINGS,
    FreshOrders,
    OrderBook,
    described,
    judged,
)
from swarm.wire.messages.orders import GiveOrder, Order

SCENARIO = parse_scenario("""
targets = [{ name = "t", count = 2 }, { name = "real", walk = "external" }]
groups = [{ name = "red", vehicles = 3, targets = ["t0"] }, { name = "blue", vehicles = 3 }]
vehicles = { per_agent = 3 }
""")
VEHICLES = [id for plan in plan_agents(SCENARIO) for id in plan.vehicle_ids]
NOW = 1_000

orders = st.builds(
    Order,
    subject=st.sampled_from(["pause", "vehicle"]),
    name=st.sampled_from(["a", "b"]),
    stamp_ns=st.integers(0, 3),
    off=st.booleans(),
)


@given(st.lists(orders, max_size=12), st.randoms(use_true_random=False))
def test_books_that_heard_the_same_are_the_same_whatever_the_order(said, chance):
    one, other = OrderBook(), OrderBook()
    one.merge(said, NOW)
    again = said * 2
    chance.shuffle(again)
    for order in again:
        other.merge([order], NOW)
    assert list(one) == list(other)
    for order in one:
        newest = max(each.stamp_ns for each in said if (each.subject, each.name) == (order.subject, order.name))
        assert order.stamp_ns == newest


class Keeper:
    """A book that orders are given to, as a keeper's."""

    def __init__(self) -> None:
        self.book = OrderBook()
        self.now = NOW

    def give(self, **fields: Any) -> str | None:
        """The reason of its refusal; None if it is not."""
        self.now += 1
        order = judged(GiveOrder(**fields), self.book, SCENARIO, VEHICLES, self.now)
        if isinstance(order, str):
            return order
        assert self.book.merge([order], self.now) == [order]
        return None


@pytest.fixture
def keeper() -> Keeper:
    return Keeper()


def test_what_is_ordered_last_counts_even_after_the_clock_was_set_back(keeper: Keeper) -> None:
    keeper.give(subject="pause")
    assert keeper.book.paused
    assert keeper.book.stopped("a0-00")
    keeper.now = 5
    keeper.give(subject="pause", off=True)
    assert not keeper.book.paused


def test_targets_come_move_and_go(keeper: Keeper) -> None:
    assert keeper.give(subject="target", name="x", cell=5, walk="still", new=True) is None
    assert list(keeper.book.targets(SCENARIO)) == ["t0", "t1", "real", "x"]
    assert keeper.book.targets_of("blue", SCENARIO) == ["t0", "t1", "real", "x"]
    assert keeper.book.targets_of("red", SCENARIO) == ["t0"]
    assert keeper.give(subject="target", name="x", cell=9) is None
    moved = keeper.book.about("target", "x")
    assert (moved.cell, moved.walk) == (9, "still")
    assert keeper.give(subject="group", name="red", targets=["x"]) is None
    assert keeper.book.targets_of("red", SCENARIO) == ["x"]
    assert keeper.give(subject="group", name="red") is None
    assert keeper.book.targets_of("red", SCENARIO) == ["t0", "t1", "real", "x"], "all, though the scenario says t0"
    assert keeper.give(subject="group", name="red", targets=["x"]) is None
    assert keeper.give(subject="target", name="x", off=True) is None
    assert keeper.book.targets_of("red", SCENARIO) == ["t0"], "removing loses nobody"
    assert keeper.give(subject="group", name="red", off=True) is None
    assert keeper.book.targets_of("red", SCENARIO) == ["t0"]
    assert keeper.give(subject="target", name="t0", off=True) is None
    assert keeper.book.targets_of("red", SCENARIO) == []
    assert keeper.book.standing == ["target t0 is removed"], "a removed target of the scenario, not an added one"
    assert keeper.give(subject="target", name="t0", cell=3, new=True) is None
    assert keeper.book.targets_of("red", SCENARIO) == ["t0"]


def test_a_setting_is_the_scenarios_again_once_it_is_taken_back(keeper: Keeper) -> None:
    keeper.give(subject="set", name="time_scale", value=7.0)
    assert keeper.book.setting("time_scale", 1.0) == 7.0
    keeper.give(subject="set", name="time_scale", off=True)
    assert keeper.book.setting("time_scale", 1.0) == 1.0


def test_every_setting_that_may_change_is_one_of_the_scenario_and_within_its_bounds() -> None:
    for key, (least, most) in SETTINGS.items():
        section, _, name = key.rpartition(".")
        for value in (least, most):
            line = f"{name} = {value}"
            parse_scenario(f"[{section}]\n{line}" if section else line)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"subject": "pause", "name": "x"}, "it has no name, found 'x'"),
        ({"subject": "vehicle", "name": "a9-00"}, "vehicle 'a9-00': there is none; there are a0-00"),
        (
            {"subject": "group", "name": "grey", "targets": ["t0"]},
            "group 'grey': there is none; there are blue, red",
        ),
        ({"subject": "group", "name": "red", "targets": ["t9"]}, "there is no target 't9'"),
        ({"subject": "target", "name": "t0", "cell": 1, "new": True}, "target 't0' is there already"),
        ({"subject": "target", "name": "y", "cell": 1}, "target 'y': there is none"),
        ({"subject": "target", "name": "y", "off": True}, "target 'y': there is none"),
        ({"subject": "target", "name": "real", "cell": 1}, "its tracker says where it is"),
        ({"subject": "set", "name": "seed", "value": 1.0}, "set 'seed': it cannot change while the swarm runs"),
        ({"subject": "set", "name": "time_scale", "value": -1.0}, "-1.0 is not in 0.001 ... 1000"),
        ({"subject": "set", "name": "time_scale"}, "None is not in"),
    ],
)
def test_what_cannot_be_ordered_is_refused_in_a_sentence(fields: dict[str, Any], says: str, keeper: Keeper) -> None:
    assert says in keeper.give(**fields)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"subject": "vehicle"}, "needs the name of a vehicle"),
        ({"subject": "vehicle", "name": "a b"}, "name 'a b' is not"),
        ({"subject": "target", "name": "x"}, "give the target's place"),
        ({"subject": "target", "name": "x", "row": 1}, "give either cell, or row and col"),
        ({"subject": "target", "name": "x", "row": 1, "col": 1, "cell": 3}, "give either cell, or row and col"),
    ],
)
def test_an_order_that_says_too_little_is_no_message(fields: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        GiveOrder(**fields)


def test_the_last_target_stays(keeper: Keeper) -> None:
    for name in ("t0", "real"):
        assert keeper.give(subject="target", name=name, off=True) is None
    refusal = keeper.give(subject="target", name="t1", off=True)
    assert "is the last one" in refusal


def test_no_target_is_added_where_no_process_moves_targets() -> None:
    tracked = parse_scenario('[[targets]]\nname = "real"\nwalk = "external"')
    refusal = judged(GiveOrder(subject="target", name="x", cell=1, new=True), OrderBook(), tracked, [], NOW)
    assert "all of its scenario have trackers" in refusal


def test_a_book_is_bounded_and_no_stamp_is_beyond_reach() -> None:
    book = OrderBook()
    assert book.merge([Order(subject="pause", name="", stamp_ns=NOW + MAX_AHEAD_NS + 1)], NOW) == []
    many = [Order(subject="vehicle", name=f"v{n}", stamp_ns=1) for n in range(MOST_ORDERS + 5)]
    assert len(book.merge(many, NOW)) == len(book) == MOST_ORDERS
    assert book.merge([Order(subject="vehicle", name="v0", stamp_ns=2, off=True)], NOW) != []
    refusal = judged(GiveOrder(subject="set", name="time_scale", value=2.0), book, SCENARIO, VEHICLES, NOW)
    assert "at most" in refusal
    pause = judged(GiveOrder(subject="pause"), book, SCENARIO, VEHICLES, NOW)
    assert isinstance(pause, Order), "there is always room for a pause"
    assert book.merge([pause], NOW) == [pause]


@settings(max_examples=20)
@given(orders)
def test_every_order_has_words(order: Order) -> None:
    assert described(order).startswith(order.subject)


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 2 * FRESH_NS)), max_size=20), st.integers(0, FRESH_NS))
def test_a_copy_of_an_order_counts_never_again_whenever_it_comes(given, since_ns):
    """Also at a keeper that has started again since, and has forgotten which orders counted."""
    stamps_ns = [since_ns + n * FRESH_NS // 2 for n in range(5)]
    fresh, counted, now_ns = FreshOrders(since_ns), [], since_ns
    for which, later_ns in given:
        now_ns += later_ns
        fault = fresh.fault(stamps_ns[which], now_ns)
        counted += [which] if fault is None else []
        if fault is not None and abs(stamps_ns[which] - now_ns) < FRESH_NS:
            assert which in counted, fault
        if counted and stamps_ns[counted[-1]] < now_ns:
            assert FreshOrders(now_ns).fault(stamps_ns[counted[-1]], now_ns) is not None
    assert len(counted) == len(set(counted))
