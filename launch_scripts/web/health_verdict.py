"""From what processes say of themselves to what a probe is told. Pure: no socket, no clock."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import NamedTuple

from swarm.clock import NS_PER_S
from swarm.runtime.health import Phase, Vitals

HEALTHY, READY = "/healthz", "/readyz"


class Process(NamedTuple):
    """One process, as whoever watches it sees it.

    name    role and id, such as planner-t0
    vitals  what it has said last; None: nothing yet
    ended   why it does not run; None: it runs
    """

    name: str
    vitals: Vitals | None
    ended: str | None = None

    def wrong(self, now_ns: int) -> str | None:
        """Why it does not live, in words; None: it does, as far as can be told. One that has ended is its
        supervisor's to start again, and does not hang."""
        if self.ended is None and self.vitals is not None and self.vitals.hangs(now_ns):
            return f"its loop hangs for {(now_ns - self.vitals.stamp_ns) / NS_PER_S:.0f} s"
        return None

    def lacks(self, now_ns: int) -> tuple[str, ...]:
        """What it lacks to do its job, in words; nothing if it is ready."""
        if self.ended is not None:
            return (self.ended,)
        if self.vitals is None:
            return ("its start",)
        wrong = self.wrong(now_ns)
        return self.vitals.lacks if wrong is None else (wrong,)

    def fields(self, now_ns: int) -> dict[str, object]:
        state = "ended" if self.ended is not None else "starts"
        if self.ended is None and self.vitals is not None:
            state = "hangs" if self.vitals.hangs(now_ns) else _STATES[self.vitals.phase]
        told: dict[str, object] = {"name": self.name, "state": state, "lacks": list(self.lacks(now_ns))}
        if self.ended is None and self.vitals is not None and self.vitals.phase is Phase.RUNS:
            told["ticked_s_ago"] = round((now_ns - self.vitals.stamp_ns) / NS_PER_S, 3)
        return told


_STATES = {Phase.STARTS: "starts", Phase.RUNS: "runs", Phase.ENDS: "ends"}


class Verdict(NamedTuple):
    """Answer to a probe.

    missing  what is wrong, or not there, one sentence each; empty if all is well
    """

    status: str
    missing: tuple[str, ...]
    processes: tuple[dict[str, object], ...]

    @property
    def ok(self) -> bool:
        return not self.missing

    @property
    def body(self) -> bytes:
        """JSON in ASCII: what processes say of themselves is safe to print."""
        return json.dumps(self._asdict(), indent=1).encode("ascii") + b"\n"


def verdict(question: str, processes: Sequence[Process], now_ns: int) -> Verdict:
    """Whether processes live (`/healthz`), or are ready (`/readyz`).

    now_ns  on the monotonic clock of the machine
    """
    missing: list[str] = []
    for each in processes:
        if question == READY:
            missing += [f"{each.name}: {need}" for need in each.lacks(now_ns)]
        elif (wrong := each.wrong(now_ns)) is not None:
            missing.append(f"{each.name}: {wrong}")
    words = ("ready", "not ready") if question == READY else ("healthy", "not healthy")
    return Verdict(words[bool(missing)], tuple(missing), tuple(each.fields(now_ns) for each in processes))
