"""The column of who may do what: complete, and of roles and fields that there are."""

import pytest

from swarm.wire.access import OPERATOR, ROLES, access
from swarm.wire.topics import TOPICS

OPERATIONS = ("put", "serve", "ask", "hear")


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_someone_may_do_all_that_a_topic_is_for_and_no_one_what_it_is_not(topic) -> None:
    granted = {name: {grant.role for grant in getattr(topic.access, name)} for name in OPERATIONS}
    assert bool(granted["put"]) == bool(granted["hear"]) == topic.published
    assert bool(granted["serve"]) == bool(granted["ask"]) == (topic.request is not None)
    # An operator reads everything and changes nothing.
    for name, may in (("put", False), ("serve", False), ("ask", topic.request), ("hear", topic.published)):
        assert (OPERATOR in granted[name]) == bool(may)
    for name in OPERATIONS:
        grants = getattr(topic.access, name)
        assert len({grant.role for grant in grants}) == len(grants)
        for grant in grants:
            assert grant.role in ROLES
            assert set(grant.own) <= set(topic.fields), "what must be its own is a field of the key"


def test_what_only_one_process_knows_only_that_process_says() -> None:
    """Processes that may put or answer for others are named here, which makes an addition visible."""
    for_others = {
        (topic.name, name, grant.role)
        for topic in TOPICS
        for name in ("put", "serve")
        for grant in getattr(topic.access, name)
        if not grant.own
    }
    assert for_others == {
        ("marks", "put", "keeper"),  # what authors that are gone have left
        ("marks", "put", "planner"),
        ("marks", "serve", "keeper"),
        ("stats", "serve", "keeper"),  # what processes that are gone have counted
        ("pushed-route", "put", "planner"),
        ("pushed-route", "put", "places"),
        ("pose", "put", "targets"),  # it moves all simulated targets
        ("true-pose", "put", "targets"),
        ("body", "put", "targets"),  # and all simulated rovers
    }


def test_a_role_that_there_is_not_is_a_bug() -> None:
    with pytest.raises(ValueError, match="no role 'agnet'"):
        access(put="agnet:author")
