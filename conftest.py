"""What all tests share: node tests each have a ROS domain of their own, which never leaves this machine."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


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
