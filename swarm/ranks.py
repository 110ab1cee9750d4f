"""Ranks: the ids of processes of which several stand ready to do one job, as the planners of one target.

The process of rank 0 is named after the job: planner `t3` serves target t3. Its standbys are `t3.r1`, `t3.r2` ...
An id is unique and says what its process may serve, so routers can grant access by it.
"""

from __future__ import annotations

import re

HIGHEST_RANK = 9
_RANKED = re.compile(rf"(.+)\.r([1-{HIGHEST_RANK}])")


def ranked_id(job: str, rank: int) -> str:
    """The id of the process of this rank for a job."""
    return f"{job}.r{rank}" if rank else job


def split_rank(id: str) -> tuple[str, int]:
    """The job and the rank of a process, by its id."""
    match = _RANKED.fullmatch(id)
    return (id, 0) if match is None else (match[1], int(match[2]))


def job_of(id: str) -> str:
    """What a process serves, whatever its rank."""
    return split_rank(id)[0]
