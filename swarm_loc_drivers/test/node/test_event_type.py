"""Events are of the type of event_camera_msgs where that is installed, else of our copy."""

import sys
from pathlib import Path
from types import ModuleType

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from node_world import Ros, overrides
from std_msgs.msg import String

from swarm_loc_drivers.pushbot.pushbot_driver_node import PushbotDriverNode
from swarm_loc_estimator.common.messages.cdr import EVENT_PACKETS
from swarm_loc_estimator.common.node import message_class
from swarm_loc_msgs.msg import EventPacket
from swarm_loc_vision.events.event_tracker_node import EventTrackerNode

Original = type("EventPacket", (EventPacket,), {})
"""Stands for the type of event_camera_msgs, which may not be installed here."""


@pytest.fixture(params=[True, False], ids=["installed", "not_installed"])
def expected(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> type:
    """The type to expect, with and without event_camera_msgs."""
    module = ModuleType("event_camera_msgs.msg")
    monkeypatch.setattr(module, "EventPacket", Original, raising=False)
    monkeypatch.setitem(sys.modules, "event_camera_msgs", ModuleType("event_camera_msgs"))
    monkeypatch.setitem(sys.modules, "event_camera_msgs.msg", module if request.param else None)
    return Original if request.param else EventPacket


@pytest.mark.parametrize("recorded", EVENT_PACKETS)
def test_players_use_it_whatever_a_bag_says(expected: type, recorded: str) -> None:
    assert message_class(recorded) is expected


def test_driver_and_tracker_use_it(ros: Ros, expected: type, tmp_path: Path) -> None:
    address = overrides(address=str(tmp_path / "pushbot1"))
    driver = ros.add(PushbotDriverNode(namespace="pushbot1", parameter_overrides=address))
    tracker = ros.add(EventTrackerNode(namespace="pushbot1"))
    topic = "/pushbot1/events"
    assert [one.msg_type for one in driver.publishers if one.topic_name == topic] == [expected]
    assert [one.msg_type for one in tracker.subscriptions if one.topic_name == topic] == [expected]


@pytest.mark.parametrize(
    ("published", "said"),
    [(String, " (published as std_msgs/msg/String)"), (message_class(EVENT_PACKETS[0]), "")],
)
def test_a_tracker_names_another_type_of_its_events(ros: Ros, published: type, said: str) -> None:
    ros.stranger().create_publisher(published, "pushbot1/events", 1)
    diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
    ros.add(EventTrackerNode(namespace="pushbot1"))
    ros.until(lambda: diagnostics and diagnostics[-1].status[0].message != "tracking")
    (status,) = diagnostics[-1].status
    assert status.message.startswith(f"no messages received on /pushbot1/events{said} for 5 s")
