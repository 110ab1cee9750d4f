"""The install of a robot: the client library imports little, quickly, and reads every message without NumPy."""

import subprocess
import sys

from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few
from support.wire_strategies import EXAMPLES, routes

from swarm.errors import EXTRAS
from swarm.wire.codec import decode, encode
from swarm.wire.messages.map_data import MarkSets
from swarm.wire.route_columns import RouteBatch

LARGE = tuple(EXTRAS)
BLOCKED = f"import sys; sys.modules.update(dict.fromkeys({LARGE!r}))\n"
"""Makes them as good as not installed."""


def python(code: str, said: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], input=said, capture_output=True, text=True, timeout=60, check=False
    )


def test_the_client_imports_nothing_large() -> None:
    code = f"import sys, swarm.client; print([name for name in {LARGE!r} if name in sys.modules])"
    assert python(code).stdout == "[]\n"


def test_without_numpy_every_message_is_read_as_with_it() -> None:
    """But many sets of marks in one message, for which a client does not ask."""
    payloads = [encode(each).hex() for each in EXAMPLES if not isinstance(each, MarkSets)]
    code = BLOCKED + (
        "import swarm.wire.topics as topics\n"
        "from swarm.wire.codec import decode, encode, schema_of_type\n"
        "import msgpack\n"
        "kinds = {schema_of_type(k): k for t in topics.TOPICS for k in (t.message, t.request) if k}\n"
        "for text in sys.stdin.read().split():\n"
        "    payload = bytes.fromhex(text)\n"
        "    kind = kinds[msgpack.unpackb(payload, strict_map_key=False)['schema']]\n"
        "    message = decode(payload, kind)\n"
        "    routes = [each.cost_s for each in message.routes] if kind.__name__ == 'RouteReply' else ''\n"
        "    print(encode(message).hex(), routes)\n"
    )
    done = python(code, "\n".join(payloads))
    assert [line.split()[0] for line in done.stdout.splitlines()] == payloads, done.stderr


@settings(max_examples=few(100))
@given(st.lists(routes, max_size=5))
def test_routes_read_as_lists_are_those_in_arrays(some: list[object]) -> None:
    batch = RouteBatch.of(some)  # type: ignore[arg-type]
    assert list(batch.columns()) == list(batch)


def test_bulk_marks_without_numpy_are_refused_in_a_sentence() -> None:
    [bulk] = [each for each in EXAMPLES if isinstance(each, MarkSets)]
    assert decode(encode(bulk), MarkSets) == bulk
    code = BLOCKED + (
        "from swarm.wire.codec import decode; from swarm.wire.messages.map_data import MarkSets\n"
        "from swarm.errors import ProtocolError\n"
        f"try: decode(bytes.fromhex('{encode(bulk).hex()}'), MarkSets)\n"
        "except ProtocolError as error: print(error)\n"
    )
    assert python(code).stdout == "many sets at once are read with NumPy only: ask without `bulk`\n"
