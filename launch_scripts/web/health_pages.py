"""Verdict of a probe from the health reports of processes. No socket."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from launch_scripts.plain_text import format_duration
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
            wrong = f"its loop hangs for {format_duration((now_ns - self.vitals.stamp_ns) / NS_PER_S)}"
            return "hangs", wrong, (wrong,)
        return self.vitals.phase.name.lower(), None, self.vitals.lacks


def verdict(question: str, processes: Sequence[Process], now_ns: int) -> Reply:
    """Returns whether processes live (`/healthz`), or are ready (`/readyz`): 200 if all is well, 503 otherwise. The
    reasons are JSON in ASCII, as what processes say of themselves is to be safe to print.

    now_ns  on the monotonic clock of the machine
    """
    missing: list[str] = []
    rows: list[dict[str, object]] = []
    for each in processes:
        state, wrong, lacks = each.seen(now_ns)
        found = lacks if question == READY else () if wrong is None else (wrong,)
        missing += [f"{each.name}: {need}" for need in found]
        row: dict[str, object] = {"name": each.name, "state": state, "lacks": lacks}
        if each.ended is None and each.vitals is not None and each.vitals.phase is Phase.RUNS:
            row["ticked_s_ago"] = round((now_ns - each.vitals.stamp_ns) / NS_PER_S, 3)
        rows.append(row)
    word = "ready" if question == READY else "healthy"
    answer = {"status": f"not {word}" if missing else word, "missing": missing, "processes": rows}
    body = json.dumps(answer, indent=1).encode("ascii") + b"\n"
    return Reply(503 if missing else 200, "application/json", body)


def health_pages(processes: Callable[[], Sequence[Process]]) -> dict[str, Page]:
    """The two pages that probes ask for."""

    def answer(question: str, query: str, headers: object) -> Reply:
        return verdict(question, processes(), time.monotonic_ns())

    return {question: partial(answer, question) for question in PROBED}
