"""Every message as a build writes it, and what a build reads of such bytes: run with the PYTHONPATH of any version.

    PYTHONPATH=TREE:TREE/tests python tests/support/wire_specimens.py write > tests/specimens/wire-8.txt
    PYTHONPATH=TREE:TREE/tests python tests/support/wire_specimens.py read < FILE

A line is the name of a message's type and its bytes in hexadecimal digits. `read` answers each line with the fields
that the build knows of the type and the message as it writes it again, or with `error` and a sentence, or with
`unknown` where it has no such type.
"""

import sys

from support.wire_strategies import EXAMPLES, MESSAGES

from swarm.errors import ProtocolError
from swarm.wire.codec import decode, encode

LONGEST_BYTES = 2000
"""Upper bound on a specimen."""
KINDS = {kind.__name__: kind for kind in MESSAGES}


def lines(many: int) -> list[str]:
    """The examples, and `many` more messages of each type."""
    from support.wire_strategies import message_of  # a build that reads may have none

    messages = [*EXAMPLES, *(message_of(kind, 50 + n) for kind in MESSAGES for n in range(many))]
    written = [(type(message).__name__, encode(message)) for message in messages]
    return list(
        dict.fromkeys(f"{name} {payload.hex()}" for name, payload in written if len(payload) < LONGEST_BYTES)
    )


def read(line: str) -> str:
    """The answer to a line."""
    name, payload = line.split()
    if name not in KINDS:
        return "unknown"
    try:
        message = decode(bytes.fromhex(payload), KINDS[name])
    except ProtocolError as error:
        return f"error {error}"
    return f"{','.join(message.__struct_fields__) or '-'} {encode(message).hex()}"


if __name__ == "__main__":
    if sys.argv[1:] == ["write"]:
        sys.stdout.write("\n".join(lines(4)) + "\n")
    else:
        sys.stdout.write("\n".join(map(read, sys.stdin.read().splitlines())) + "\n")
