"""Planners with a scripted tree, before and after the first pose of their target."""

import pytest
from support.scripted_planner import World


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def ready() -> World:
    """Knows the target at row 10, col 20, and has its tree."""
    world = World()
    world.pose(10, 20)
    world.tick()
    assert world.tree.ready
    world.tree.calls.clear()
    return world
