"""Anonymous detections over DDS: who is who comes out, and what is wrong with them is told."""

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from node_world import STEP_NS, T0_NS, TRUE_POSES, Robots, Ros, newest_status, stamp_ns, values_of

from swarm_loc_estimator.common.messages.detections import ANONYMOUS_DTYPE, encode_detections
from swarm_loc_msgs.msg import AnonymousDetectionArray, RobotIdentities


def image(frame: str, at_ns: int) -> bytes:
    """Beta, alpha and a stranger."""
    shown = np.zeros(3, dtype=ANONYMOUS_DTYPE)
    shown["x"], shown["y"] = np.array([TRUE_POSES["beta"], TRUE_POSES["alpha"], (5.0, 5.0, 0.0)]).T[:2]
    shown["theta"] = np.nan
    shown["covariance"][:, 0, 0] = -1.0
    return encode_detections(frame, at_ns, shown)


def test_robots_seen_from_above_are_told_apart_and_a_wrong_frame_is_named(ros: Ros, robots: Robots) -> None:
    identities = ros.listen(RobotIdentities, "aerial/identities")
    reports = ros.listen(DiagnosticArray, "/diagnostics")
    camera = ros.tester.create_publisher(AnonymousDetectionArray, "aerial/detections", 10)
    ros.until(lambda: camera.get_subscription_count() and ros.tester.count_publishers("aerial/identities"))
    seen_ns = robots.run(T0_NS, 20)
    camera.publish(image("map", seen_ns))
    now_ns = robots.run(seen_ns + STEP_NS, 4)
    ros.until(lambda: identities)
    newest = identities[-1]
    assert (newest.header.frame_id, stamp_ns(newest)) == ("map", seen_ns)
    assert [(one.name, one.detection) for one in newest.identities] == [("alpha", 1), ("beta", 0)]
    assert all(one.probability > 0.99 for one in newest.identities)

    camera.publish(image("table", now_ns))
    last_ns = robots.run(now_ns + STEP_NS, 4)
    ros.until(lambda: reports and stamp_ns(reports[-1]) >= last_ns)
    status = newest_status(reports, "estimator")
    values = values_of(status)
    assert values["dropped: aerial_frame"] == "1"
    assert values["dropped: aerial_unassigned"] == "1"
    assert values["aerial/detections received"] == "2"
    assert "aerial/detections is in frame 'table' but must be in 'map'" in status.message
    assert values_of(newest_status(reports, "estimator: alpha"))["aerial detection"] == "1"
