"""Access rules per topic, which are a column of the table of topics; and codes that authenticate the sender.

A router enforces these rules, so they are complete: it denies everything that no topic grants. A router itself
passes on everybody's messages, may therefore do everything, and is named nowhere.

Without certificates a message counts only with a code that the processes of one run alone can make
(docs/design/security.md). The code is a keyed BLAKE2b (RFC 7693) of the key, the query if it is a reply, and the
payload. It travels beside the payload, as Zenoh's attachment, so a process without the secret may still read. A
topic names the acts which count without (`Topic.free`)."""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, Literal

from swarm.errors import ProtocolError

if TYPE_CHECKING:
    from swarm.wire.topics import Topic

MEMBERS = "keeper planner places agent targets tracker rover monitor"
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
    """Permission of one role for one action on a topic.

    own  fields of the key which must be the process's own: its id, its role, or its name as an author
    """

    role: str
    own: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Access:
    """Access rules of a topic, as the router enforces them.

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
    `put="agent:author keeper"`. Operators may always subscribe to published topics and query served ones. Raises
    ValueError on an unknown role."""
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


CODE_BYTES = 16
"""128 bits, which cannot be guessed; half of them would do for a run of hours."""


class Authenticator:
    """Makes and checks the codes of one run.

    secret  shared by the processes of the run, and by no others
    run_id  of the run: messages of another run do not count. Routers have none: for their figures it is empty
    """

    def __init__(self, secret: bytes, run_id: str) -> None:
        self._key = blake2b(run_id.encode(), key=secret, digest_size=32).digest()
        self._routers = blake2b(b"", key=secret, digest_size=32).digest()

    def code(self, key: str, payload: bytes, asked: bytes = b"") -> bytes:
        """The code of a payload under a key.

        asked  the payload of the question, where this is an answer to one
        """
        lengths, own = f"{len(key)},{len(asked)},".encode(), self._routers if "stats/router/" in key else self._key
        return blake2b(lengths + key.encode() + asked + payload, key=own, digest_size=CODE_BYTES).digest()


Act = Literal["put", "ask", "answer"]
"""Use of a message: it is published, is a query, or is a reply to one."""


def code_of(authenticator: Authenticator | None, key: str, payload: bytes, asked: bytes = b"") -> bytes | None:
    """Returns the attachment of a payload: its code; None if no secret is shared."""
    return None if authenticator is None else authenticator.code(key, payload, asked)


def has_code(
    authenticator: Authenticator | None, code: bytes | None, key: str, payload: bytes, asked: bytes = b""
) -> bool:
    """Returns True if a process of the run has made this code; always without an authenticator, as then
    certificates prove names."""
    if authenticator is None:
        return True
    return code is not None and hmac.compare_digest(code, authenticator.code(key, payload, asked))


def check_code(
    authenticator: Authenticator | None,
    code: bytes | None,
    topic: Topic,
    act: Act,
    key: str,
    payload: bytes,
    asked: bytes = b"",
) -> None:
    """Raises ProtocolError on what no process of the run has said, unless the topic lets strangers say it."""
    if authenticator is None or act in topic.free:
        return
    if not payload:
        raise ProtocolError("its fields are not in a payload, which alone a code can cover")
    if not has_code(authenticator, code, key, payload, asked):
        what = "no code" if code is None else "a false code"
        raise ProtocolError(f"it carries {what}, so no process of this run has said it")
