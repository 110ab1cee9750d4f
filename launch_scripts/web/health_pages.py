"""Verdict of a probe from the health reports of processes. No socket."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from launch_scripts.plain_text import Duration
from launch_scripts.web import PROBED, READY, Page, Reply
from swarm.clock import NS_PER_S
from swarm.runtime.loop_health import Phase, Vitals


class Process(NamedTuple):
    """One process, as its watcher sees it.

    name    role and id, such as planner-t0
    vitals  its last report of its own state; None if it has sent none yet
    ended   why it ended, as a sentence; None while it runs
    """

    name: str
    vitals: Vitals | None
    ended: str | None = None

    def seen(self, now_ns: int) -> tuple[str, str | None, tuple[str, ...]]:
        """(state, why it does not live, what it lacks to do its job). A process that has ended does not hang: its
        supervisor starts it again."""
        if self.ended is not None:
            return "ended", None, (self.ended,)
        if self.vitals is None:
            return "starts", None, ("its start",)
        if self.vitals.hangs(now_ns):
            wrong = f"its loop hangs for {Duration((now_ns - self.vitals.stamp_ns) / NS_PER_S)}"
            return "hangs", wrong, (wrong,)
        return self.vitals.phase.name.lower(), None, self.vitals.lacks

    def fields(self, now_ns: int) -> dict[str, object]:
        """Fields of the process as JSON."""
        state, _, lacks = self.seen(now_ns)
        told: dict[str, object] = {"name": self.name, "state": state, "lacks": list(lacks)}
        if self.ended is None and self.vitals is not None and self.vitals.phase is Phase.RUNS:
            told["ticked_s_ago"] = round((now_ns - self.vitals.stamp_ns) / NS_PER_S, 3)
        return told


class Verdict(NamedTuple):
    """The answer to a probe.

    missing  faults and missing parts, one sentence each; empty if all is well
    """

    status: str
    missing: tuple[str, ...]
    processes: tuple[dict[str, object], ...]

    @property
    def ok(self) -> bool:
        """True if all is well."""
        return not self.missing

    @property
    def body(self) -> bytes:
        """JSON in ASCII: what processes say of themselves is safe to print."""
        return json.dumps(self._asdict(), indent=1).encode("ascii") + b"\n"


def verdict(question: str, processes: Sequence[Process], now_ns: int) -> Verdict:
    """Returns whether processes live (`/healthz`), or are ready (`/readyz`).

    now_ns  on the monotonic clock of the machine
    """
    missing: list[str] = []
    for each in processes:
        _, wrong, lacks = each.seen(now_ns)
        found = lacks if question == READY else () if wrong is None else (wrong,)
        missing += [f"{each.name}: {need}" for need in found]
    word = "ready" if question == READY else "healthy"
    status = f"not {word}" if missing else word
    return Verdict(status, tuple(missing), tuple(each.fields(now_ns) for each in processes))


def health_pages(processes: Callable[[], Sequence[Process]]) -> dict[str, Page]:
    """The two pages that probes ask for: 200 if all is well, 503 otherwise, with the reasons as JSON."""

    def answer(question: str, query: str, headers: object) -> Reply:
        found = verdict(question, processes(), time.monotonic_ns())
        return Reply(200 if found.ok else 503, "application/json", found.body)

    return {question: partial(answer, question) for question in PROBED}
