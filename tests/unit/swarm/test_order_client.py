"""Questions of a process that starts, and its answers to operators and to other processes."""

from typing import Any
from unittest.mock import Mock

import pytest

from swarm.bus.bus import Asked, AskEnded, Heard
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario
from swarm.runtime.order_book import OrderClient
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages import Nothing
from swarm.wire.messages.orders import Obey, Order, Orders
from swarm.wire.topics import OBEYED, ORDERS

PAUSE = Order(subject="pause", name="", stamp_ns=7)


@pytest.fixture
def bus() -> Mock:
    return Mock()


def client_on(bus: Mock, **given: Any) -> OrderClient:
    return OrderClient(RoleSetup(Scenario(), "r", "agent", "a0", 1, 0), bus, Mock(), **given)


def asked(topic: Any, request: Any, *, expired: bool = False) -> tuple[Asked, Mock]:
    answerer = Mock(timeout_s=2.0)
    answerer.waited_s.return_value = 2.0 if expired else 0.0
    return Asked(topic, {}, request, answerer), answerer


@pytest.mark.parametrize(("failure", "times"), [(None, 4), ("timeout", 10)])
def test_a_process_asks_keepers_twice_and_then_all_four_times_a_second_until_it_goes_on_without(
    bus: Mock, failure: str | None, times: int
) -> None:
    client = client_on(bus)
    client.start(0)
    at_ns = [0]
    for now_ns in range(0, 4 * NS_PER_S, NS_PER_S // 20):
        client.tick(now_ns)
        if bus.ask.call_count > len(at_ns):
            at_ns.append(now_ns)
        client.on_order_event(AskEnded("orders", ORDERS, 0, failure), now_ns)
        assert client.known == (len(at_ns) == times)
    assert at_ns == [n * NS_PER_S // 4 for n in range(times)]
    assert [call.kwargs.get("role") for call in bus.ask.call_args_list] == ["keeper"] * 2 + [None] * (times - 2)


def test_a_process_tells_its_orders_to_others_once_it_knows_them(bus: Mock) -> None:
    client = client_on(bus)
    early, of_early = asked(ORDERS, Nothing())
    client.on_order_event(early, 0)
    assert not of_early.answer.called
    assert client.on_order_event(Heard(ORDERS, {}, Orders(role="keeper", id="0", orders=[PAUSE])), 1)
    late, of_late = asked(ORDERS, Nothing())
    client.on_order_event(late, 2)
    assert of_late.answer.call_args.args[0] == Orders(role="agent", id="a0", orders=[PAUSE])
    assert of_early.end.called
    assert of_late.end.called


def test_an_operator_is_answered_once_the_order_is_known_and_obeyed(bus: Mock) -> None:
    obeys = Mock(return_value=False)
    client = client_on(bus, obeys=obeys)
    order = Obey(subject="pause", stamp_ns=7)
    waits, of_waits = asked(OBEYED, order)
    gone, of_gone = asked(OBEYED, order, expired=True)
    client.on_order_event(waits, 0)
    client.on_order_event(gone, 0)
    assert not obeys.called, "it does not know it yet"
    client.on_order_event(Heard(ORDERS, {}, Orders(role="keeper", id="0", orders=[PAUSE])), 1)
    client.tick(2)
    assert not of_waits.end.called
    obeys.return_value = True
    client.tick(3)
    client.tick(4)
    assert of_waits.answer.call_count == of_waits.end.call_count == of_gone.end.call_count == 1
    assert not of_gone.answer.called


def test_the_sixty_fifth_operator_that_waits_is_refused(bus: Mock) -> None:
    client = client_on(bus)
    answerers = []
    for _ in range(65):
        event, answerer = asked(OBEYED, Obey(subject="pause", stamp_ns=7))
        client.on_order_event(event, 0)
        answerers.append(answerer)
    assert [answerer.refuse.called for answerer in answerers] == [False] * 64 + [True]
