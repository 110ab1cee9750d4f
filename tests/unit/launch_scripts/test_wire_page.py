"""docs/wire.md says what the declarations say."""

from __future__ import annotations

from docs.generate import wire_page as wire_doc
from swarm.wire.topics import TOPICS


def test_the_page_is_current():
    assert wire_doc.PATH.read_text(encoding="utf-8") == wire_doc.document(), "run `python -m docs.generate`"


def test_every_key_message_and_field_is_on_the_page():
    page = wire_doc.document()
    for topic in TOPICS:
        assert f"| `{topic.key}` |" in page
        for message in filter(None, (topic.message, topic.request)):
            assert f"### {message.__name__}\n" in page
            assert f'"{message.__struct_config__.tag}"' in page
            for field in message.__struct_fields__:
                assert f"| `{field}` |" in page
