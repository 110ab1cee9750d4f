"""Who may do what with a topic: a column of the table of topics.

A router grants by these rules, so they are complete: what no topic grants, nobody may do. A router itself passes on
everybody's messages, may therefore do everything, and is named nowhere.
"""

from __future__ import annotations

from dataclasses import dataclass

MEMBERS = "keeper planner agent targets tracker rover monitor"
"""The roles of the processes of a run. Two are external: a `tracker` publishes the pose of one real target, a
`rover` where one vehicle is that no agent drives."""
OPERATOR = "operator"
"""People's tools and the launcher: hear and ask everything, and so give orders. No group is called so, as zones are
marks of this one."""
ROLES = (*MEMBERS.split(), OPERATOR)
"""Every role but the router's."""
MEMBERS_OWN = " ".join(f"{role}:role,id" for role in MEMBERS.split())
"""Each member, under a key that names its role and id."""


@dataclass(frozen=True, slots=True)
class Grant:
    """A role that may do something.

    own  fields of the key that must be the process's own: its id, its role, or its name as an author
    """

    role: str
    own: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Access:
    """Who may do what, as the router enforces it.

    put    publish a value
    serve  declare a queryable and reply
    ask    send a query
    hear   subscribe
    """

    put: tuple[Grant, ...] = ()
    serve: tuple[Grant, ...] = ()
    ask: tuple[Grant, ...] = ()
    hear: tuple[Grant, ...] = ()


def access(*, put: str = "", serve: str = "", ask: str = "", hear: str = "") -> Access:
    """Access from roles separated by blanks, each with the fields of the key that must be its own after a colon:
    `put="agent:author keeper"`. Operators may hear what is put and ask what is served, always. Raises ValueError on
    an unknown role."""
    return Access(
        put=_grants(put),
        serve=_grants(serve),
        ask=_grants(f"{ask} {OPERATOR}" if serve else ask),
        hear=_grants(f"{hear} {OPERATOR}" if put else hear),
    )


def _grants(text: str) -> tuple[Grant, ...]:
    grants = []
    for word in text.split():
        role, _, fields = word.partition(":")
        if role not in ROLES:
            raise ValueError(f"no role {role!r}; the roles are {', '.join(ROLES)}")
        grants.append(Grant(role, tuple(fields.split(",")) if fields else ()))
    return tuple(grants)
