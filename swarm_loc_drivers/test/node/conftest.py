"""Fixtures of the node tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from node_world import Ros


@pytest.fixture
def ros() -> Iterator[Ros]:
    """ROS, for one test."""
    ros = Ros()
    yield ros
    ros.close()
