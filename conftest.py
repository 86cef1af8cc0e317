"""What all tests share: node tests each have a ROS domain of their own, which never leaves this machine."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

# Each run draws examples of its own; where CI is set all draw the same, so that only a change can break a
# test there. How long an example takes says nothing: the machine may be busy, the first call may compile.
settings.register_profile(
    "workspace", derandomize="CI" in os.environ, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("workspace")


@pytest.fixture(autouse=True)
def _own_ros_domain(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Give a test under `test/node` a domain that no other test on this machine has at the same time."""
    if "node" not in request.path.parts:
        yield
        return
    from domain_coordinator import domain_id  # noqa: PLC0415 - unit tests do without ROS

    with domain_id() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield
