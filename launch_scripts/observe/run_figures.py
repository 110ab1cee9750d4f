"""The figures of a run at successive instants: all that the live view needs of it, and what a recorder begins with.

Pure: time is an argument, and the owner of a bus passes it what comes on `HEARD` of `run_state/model.py`.
"""

from __future__ import annotations

from collections.abc import Mapping

from launch_scripts.observe.plan import plan_of
from launch_scripts.observe.run_model import RunModel
from launch_scripts.observe.samples import Sample, Samples, buckets_of
from launch_scripts.observe.state import RunState
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario
from swarm.grid import GridSpec
from swarm.liveness import Peer
from swarm.wire.messages import Message

_SAMPLE_NS = NS_PER_S
_SHOWN_NS = 5 * NS_PER_S // 4
"""So old may be what is shown: a sample is taken with the first message after its second."""


class RunFigures:
    """Samples of a run, in memory which does not grow with the rate of messages."""

    def __init__(self, scenario: Scenario, grid: GridSpec, started_ns: int | None = None) -> None:
        """started_ns  when the run began; None: with the first message"""
        self.scenario = scenario
        self.grid = grid
        self.model = RunModel(plan_of(scenario, started_ns), grid)
        self.observed, self.tracked, self.book = self.model.observed, self.model.tracked, self.model.book
        self.samples = Samples()
        self._sample_due_ns: int | None = None
        self._sampled: tuple[int, RunState] | None = None
        """When the last sample was taken or shown, and of which state."""

    def heard(self, message: Message, fields: Mapping[str, str], now_ns: int) -> None:
        """Takes in one message; `fields` are the chunks of its key."""
        if self.model.heard(message, now_ns) is not None:
            self._look(now_ns)

    def alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        """A liveliness token rose or fell."""
        self.model.alive(peer, up, now_ns)
        self._look(now_ns)

    def finish(self, now_ns: int) -> None:
        """The run is over: its last sample is of its end."""
        self._add_sample(now_ns)

    def summary(self, now_ns: int) -> RunState:
        """What the run is at a time."""
        return self.model.state(now_ns)

    def shown(self, now_ns: int) -> RunState:
        """What people are shown: the state of the last sample, so that it is made once a second for all. Anew where
        the swarm has said nothing since, as that is news, too."""
        if self._sampled is None or not 0 <= now_ns - self._sampled[0] <= _SHOWN_NS:
            self._sampled = now_ns, self.summary(now_ns)
        return self._sampled[1]

    def _look(self, now_ns: int) -> None:
        if self._sample_due(now_ns):
            self._add_sample(now_ns)

    def _sample_due(self, now_ns: int) -> bool:
        return self._sample_due_ns is None or now_ns >= self._sample_due_ns

    def _add_sample(self, now_ns: int) -> None:
        self._sample_due_ns = now_ns + _SAMPLE_NS
        state = self.summary(now_ns)
        self._sampled = now_ns, state
        self.samples.add(self._sample(state))

    def _sample(self, state: RunState) -> Sample:
        return Sample(
            time_s=state.elapsed_s,
            states=tuple(state.states.values()),
            captures=state.captures,
            marks=state.marks,
            reroute_requests=state.reroute_requests,
            routes_served=state.routes_served,
            messages_per_s=state.messages_per_s,
            alive=state.alive,
            gaps={line.id: line.gap.mean for line in state.targets if line.gap and line.gap.mean is not None},
            growth_ms={line.id: line.growth_ms for line in state.targets if line.growth_ms is not None},
            gap_excess=buckets_of(self.observed.histogram("followed_gap_excess").buckets),
        )
