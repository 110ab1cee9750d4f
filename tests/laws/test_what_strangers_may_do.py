"""A program on loopback without the secret of the run changes nothing but what the table of topics leaves free, and
the effect of each of these ends with it."""

from typing import Any

from laws.test_no_message_harms import Lied
from support.effort import few

from swarm.wire.topics import TOPICS

PASSES = {
    ("run", "ask"): "answered from memory, once",
    (
        "run",
        "answer",
    ): "ends only a process that starts and hears no true answer; a confirmed one names the stranger",
    ("marks", "ask"): "1,024 questions wait, which are answered by turns; others ask again",
    ("base-map", "ask"): "answered beside the loop, from a cache",
    ("base-tiles", "ask"): "answered beside the loop, some pieces a request",
    (
        "pose",
        "put",
    ): "a tracker owns its target for its lease, 60 s at most; made-up targets are forgotten as it ends",
    ("body", "put"): "closes cells for its lease, 10 s at most",
    ("route", "ask"): "a budget a tick, after agents",
    ("cost", "ask"): "a budget a tick, after agents",
    ("place-route", "ask"): "a budget a tick, after agents",
    ("nameless-route", "ask"): "shares one turn, after agents",
    ("nameless-cost", "ask"): "shares one turn, after agents",
    ("stats", "ask"): "answered from memory, 2^15 figures at most",
}
"""(topic, act) -> why the effect of a stranger's act ends with it."""


def ignore(event: object) -> None:
    pass


def history(*, lies: bool, secret: bool = False) -> list[tuple[Any, ...]]:
    """Deliveries between the services of a run, but for their counts, with a liar on each act that is not free.

    secret  whether the liar has the secret of the run
    """
    swarm = Lied("plain", "running", 4, secret=secret)
    liar, since = swarm.liar, len(swarm.deliveries)
    if lies:
        liar.listen()
        liar.serve([each for each in TOPICS if each.request and "answer" not in each.free], refuses=False)
    for _ in range(few(60)):
        for topic in TOPICS if lies else ():
            if topic.published and "put" not in topic.free:
                liar.put(topic)
            if topic.request is not None and "ask" not in topic.free:
                liar.ask(topic, ignore)
        swarm.run(0.1)
    assert liar.told > 500 or not lies
    liar.bus.close()
    swarm.run(2)
    swarm.close()
    deliveries = swarm.deliveries[since:]
    return [each for each in deliveries if not {"liar", "ear"}.intersection(each[1:3]) and each[3] != "stats"]


def test_of_each_act_that_needs_no_code_it_is_said_why_its_effect_passes() -> None:
    assert {(topic.name, act) for topic in TOPICS for act in topic.free} == set(PASSES)


def test_all_else_that_a_stranger_says_changes_no_message_of_the_run() -> None:
    silent = history(lies=False)
    assert len(silent) > 500
    assert history(lies=True) == silent
    assert history(lies=True, secret=True) != silent
