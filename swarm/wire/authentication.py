"""Codes that only the processes of one run can make: on a topic where a false message would harm, a message counts
only with its code (decision 32).

A code is a keyed BLAKE2b (RFC 7693) of the key, of what was asked if it is an answer, and of the payload. It
travels beside the payload, as Zenoh's attachment, so who has no secret may still read.
"""

from __future__ import annotations

import hmac
from hashlib import blake2b

from swarm.errors import ProtocolError
from swarm.wire.topics import Topic

_CODE_BYTES = 16


class Authenticator:
    """Makes and checks the codes of one run.

    secret  what the processes of the run share and nobody else knows
    run_id  of the run: what was said in another one does not count
    """

    def __init__(self, secret: bytes, run_id: str) -> None:
        self._key = blake2b(run_id.encode(), key=secret, digest_size=32).digest()

    def code(self, key: str, payload: bytes, asked: bytes = b"") -> bytes:
        """The code of a payload under a key.

        asked  the payload of the question, where this is an answer to one
        """
        lengths = f"{len(key)},{len(asked)},".encode()
        return blake2b(lengths + key.encode() + asked + payload, key=self._key, digest_size=_CODE_BYTES).digest()


def code_of(
    authenticator: Authenticator | None, topic: Topic, key: str, payload: bytes, asked: bytes = b""
) -> bytes | None:
    """What to send beside a payload: its code, on a trusted topic; None where no secret is shared."""
    return authenticator.code(key, payload, asked) if authenticator is not None and topic.trusted else None


def check_code(
    authenticator: Authenticator | None,
    code: bytes | None,
    topic: Topic,
    key: str,
    payload: bytes,
    asked: bytes = b"",
) -> None:
    """Raise ProtocolError on what no process of the run has said, on a trusted topic."""
    right = code_of(authenticator, topic, key, payload, asked)
    if right is None or (code is not None and hmac.compare_digest(code, right)):
        return
    what = "no code" if code is None else "a false code"
    raise ProtocolError(f"it carries {what}, so no process of this run has said it")
