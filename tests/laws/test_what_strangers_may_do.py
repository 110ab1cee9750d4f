"""A program on loopback without the secret of the run changes nothing but what the table of topics leaves free, and
the effect of each of these ends with it."""

from typing import Any

from laws.test_no_message_harms import May, lied_to
from support.effort import few

from swarm.wire.topics import TOPICS

PASSES = {
    "run": "ask answer", "marks": "ask", "base-map": "ask", "base-tiles": "ask", "pose": "put", "body": "put",
    "route": "ask", "cost": "ask", "place-route": "ask", "nameless-route": "ask", "nameless-cost": "ask",
    "stats": "ask",
}  # fmt: skip
"""Topic -> acts of strangers whose effect ends with them, because

- a tracker owns its target for its lease, 60 s at most, and a made-up target is forgotten once its lease is over;
- an obstacle closes cells for its lease, 10 s at most;
- questions for routes and costs have a budget in each tick, after those of agents;
- of questions for marks 1,024 wait, which are answered by turns, and others ask again;
- the terrain is answered beside the loop, and figures from memory, 2^15 at most;
- a false run ends only a process which starts and hears no true answer; a confirmed one names the stranger.
"""


def history(may: May, *, secret: bool = False) -> list[tuple[Any, ...]]:
    """Deliveries between the services of a run, except for their counts, with a liar.

    may     which topics and acts it uses
    secret  whether it has the secret of the run
    """
    swarm = lied_to("plain", "running", 4, few(60), True, secret=secret, may=may)
    swarm.run(2)
    swarm.close()
    return [each for each in swarm.deliveries if not {"liar", "ear"}.intersection(each[1:3]) and each[3] != "stats"]


def test_each_act_that_needs_no_code_is_one_whose_effect_passes() -> None:
    assert {topic.name: " ".join(topic.free) for topic in TOPICS if topic.free} == PASSES


def test_all_else_that_a_stranger_says_changes_no_message_of_the_run() -> None:
    silent = history(lambda topic, act: False)
    assert len(silent) > 500
    assert history(lambda topic, act: act not in topic.free) == silent
    assert history(lambda topic, act: act not in topic.free, secret=True) != silent
