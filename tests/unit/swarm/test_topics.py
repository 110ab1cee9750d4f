"""Key expressions: a composed key comes apart again, and only a composed one. Ids, of which they are made."""

import itertools
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.wire.topics import FLEET, KNOWN, MARKS, POSE, TOPICS

chunks = st.text("abzAZ09_.-", min_size=1, max_size=12)
topics = st.sampled_from(TOPICS)


@given(st.data(), topics, chunks)
def test_a_key_parses_back_to_its_fields_and_those_not_given_are_wildcards(data, topic, namespace):
    given_fields = data.draw(st.sets(st.sampled_from(topic.fields)) | st.just(set(topic.fields)))
    drawn = {name: data.draw(chunks) for name in topic.fields if name in given_fields}
    expression = topic.expression(namespace, **drawn)
    assert topic.parse(namespace, expression) == {name: drawn.get(name, "*") for name in topic.fields}
    assert expression.count("*") == len(topic.fields) - len(drawn)
    if len(drawn) == len(topic.fields):
        assert topic.keyed(namespace, **drawn) == expression


def test_no_key_belongs_to_two_topics():
    for one, other in itertools.permutations(TOPICS, 2):
        key = one.keyed("swarm", **dict.fromkeys(one.fields, "x"))
        assert other.parse("swarm", key) is None, (one.name, other.name)


def test_names_are_unique_and_every_topic_is_published_or_served():
    assert len({topic.name for topic in TOPICS}) == len({topic.key for topic in TOPICS}) == len(TOPICS)
    assert all(topic.published or topic.request for topic in TOPICS)


@given(st.data(), topics)
def test_a_key_that_is_remembered_is_the_one_that_would_be_made(data, topic):
    drawn = {name: data.draw(chunks | st.integers(0, 9)) for name in topic.fields}
    named = {name: str(value) for name, value in drawn.items()}
    backwards = dict(reversed(drawn.items()))
    for given_fields in (drawn, drawn, backwards, named):
        assert topic.value(given_fields) == (named, topic.key.format(**named))
    with pytest.raises(TypeError, match="has no field colour"):
        topic.value(drawn | {"colour": "red"})


@pytest.mark.parametrize("wrong", ["", "a/b", "a*", "$*", "**", "a b", "a?b", "a#", "\n"])
def test_what_is_not_one_chunk_is_refused(wrong):
    with pytest.raises(ValueError, match="part of a key"):
        POSE.keyed("swarm", target=wrong)
    with pytest.raises(ValueError, match="part of a key"):
        POSE.expression("swarm", target=wrong)


def test_the_key_of_one_value_needs_every_field_and_no_other():
    with pytest.raises(TypeError, match="needs the field author"):
        FLEET.keyed("swarm", region=3)
    with pytest.raises(TypeError, match="needs the field target"):
        POSE.keyed("swarm", target="*")
    with pytest.raises(TypeError, match="has no field targte; it has target"):
        POSE.expression("swarm", targte="t0")


@pytest.mark.parametrize(
    "key",
    ["swarm", "swarm/", "other/known/a0", "swarm/known/a0/x", "swarm/known/", "swarmknown/a0", "swarm/marks/1/2"],
)
def test_a_key_of_something_else_has_no_fields(key):
    assert KNOWN.parse("swarm", key) is None
    assert MARKS.parse("swarm", key) is None


def test_no_thread_meets_a_message_type_that_msgspec_has_not_finished_describing() -> None:
    # The first conversion to a struct type is not thread-safe in msgspec: another thread that meets the unfinished
    # description crashes the process. For this reason each type is converted to once, on import.
    program = """
import msgspec, msgspec._utils as utils
from swarm.wire import topics

def describe(*_):
    raise SystemExit("described a struct after the import")

utils._eval_type = describe
for topic in topics.TOPICS:
    for kind in (topic.message, topic.request):
        if kind is not None:
            try:
                msgspec.convert({}, kind)
            except msgspec.ValidationError:
                pass
"""
    subprocess.run([sys.executable, "-c", program], check=True)
