"""A monitor works as much as it draws, and a launcher as much as it records, however much is said meanwhile."""

from collections import Counter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.monitor_rig import NOBODY, SOMEBODY, Rig, little_scenario, little_terrain, say
from support.swarm_model import SwarmModel
from support.target_reports import fleet

from launch_scripts.launcher.watcher import Watcher
from launch_scripts.observe.recorder import Recorder
from launch_scripts.observe.run_observer import RECORDED
from launch_scripts.web.http_server import Audience
from swarm.bus.memory_bus import MemoryBus
from swarm.wire.messages.vehicles import Followed
from swarm.wire.topics import FLEET, FOLLOWED

AGENTS = ("a0", "a1", "a2")
BURSTS = st.lists(st.integers(1, 9), min_size=12, max_size=12)
"""Messages of each agent in each tenth of a second."""


@pytest.fixture(scope="module", autouse=True)
def decoded() -> Any:
    """Node and topic -> how many payloads it has decoded."""
    counts: Counter[tuple[str, str]] = Counter()
    before = MemoryBus._event_of

    def heard(self: MemoryBus, sample: Any, together: bool = False) -> Any:
        counts[self.node, sample.topic.name] += 1
        return before(self, sample, together)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MemoryBus, "_event_of", heard)
        yield counts


def speak(speaker: MemoryBus, tenth: int, times: int) -> None:
    for n in range(times):
        for agent in AGENTS:
            report = fleet(100.0 * tenth + n, (f"{agent}-00", n), author=f"{agent}.1", seq=10 * tenth + n)
            say(speaker, little_terrain(), report)
            route = Followed(
                vehicle=f"{agent}-00", target="t0", start=0, directions=b"", cost_s=1.0, lower_bound_s=1.0
            )
            speaker.publish(FOLLOWED, route, agent=agent, vehicle=f"{agent}-00")


@settings(max_examples=8, deadline=None)
@given(bursts=BURSTS, audience=st.sampled_from([NOBODY, SOMEBODY]))
def test_a_monitor_decodes_of_each_key_what_it_draws_however_often_it_is_told(
    decoded: Counter[tuple[str, str]], bursts: list[int], audience: Audience
) -> None:
    rig = Rig(little_scenario(), little_terrain(), None, audience=audience)
    decoded.clear()
    frames = rig.service._frame
    for tenth, times in enumerate(bursts, start=1):
        speak(rig.speaker, tenth, times)
        rig.run(0.1)
    frames = rig.service._frame - frames
    assert frames <= (len(bursts) if audience.now else len(bursts) // 2 + 1)
    assert decoded["monitor", FLEET.name] <= frames * len(AGENTS)
    assert decoded["monitor", FOLLOWED.name] <= 3 * len(AGENTS), "twice a second at most"
    rig.close()


@settings(max_examples=8, deadline=None)
@given(bursts=BURSTS)
def test_a_launcher_decodes_of_each_key_what_it_records_however_often_it_is_told(
    decoded: Counter[tuple[str, str]], bursts: list[int]
) -> None:
    swarm = SwarmModel()
    watcher = Watcher(swarm.bus("launcher"), Recorder(swarm.scenario, swarm.terrain.grid), swarm.scheduler.clock)
    speaker = swarm.bus("speaker")
    decoded.clear()
    for tenth, times in enumerate(bursts, start=1):
        speak(speaker, tenth, times)
        swarm.run(0.1)
        watcher.listen(0.0)
    lasted_s = len(bursts) / 10
    assert decoded["launcher", FLEET.name] <= (lasted_s // RECORDED[FLEET] + 1) * len(AGENTS)
    assert decoded["launcher", FOLLOWED.name] <= len(AGENTS), "the first, then once in two seconds"
    assert watcher.known.observed.vehicles().ids == [f"{agent}-00" for agent in AGENTS]
