"""Frames: of odometry, and of transforms, where each frame must have one parent."""

from __future__ import annotations

from collections.abc import Iterator

from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.messages.definitions import TRANSFORMS
from swarm_loc_estimator.doctor.evidence import Evidence, Finding, decoded, same_type
from swarm_loc_estimator.nodes.parameters import EstimatorParameters


def check_frames(evidence: Evidence) -> Iterator[Finding]:
    """Frames are named as the estimator expects them, and form a tree."""
    parents: dict[tuple[str, str], set[str]] = {}
    for name, heard in evidence.topics.items():
        if same_type(heard.type, TRANSFORMS):
            tree = name.removesuffix("tf_static").removesuffix("tf")
            for message in decoded(heard)[0]:
                for one in message.transforms:
                    child = one.child_frame_id.lstrip("/")
                    parents.setdefault((tree, child), set()).add(one.header.frame_id.lstrip("/"))
    for (tree, child), names in parents.items():
        if len(names) > 1:
            problem = f"has {len(names)} parents on {tree}tf: {listed(sorted(names))}"
            remedy = "Let only one node publish it; only the estimator may publish map to odom"
            yield Finding(f"frame '{child}'", problem, remedy)
        if child in names:
            yield Finding(
                f"frame '{child}'", "is its own parent", "Correct header.frame_id of that transform"
            )
    yield from _of_fixes(evidence)
    children = {child for _, child in parents}
    _, statistics, ingest = evidence.read
    parameters = EstimatorParameters()
    for number, topic in enumerate(evidence.inputs):
        if topic.kind.rows != "odometry" or not topic.kind.of_each or not statistics[number].received:
            continue
        found = ingest.frame_id(number)
        expected = parameters.odom_frame_of(evidence.swarm.robots[topic.robot].name)
        if found != expected and (not found or found not in children):
            problem = f"is in frame '{found}', but the estimator publishes transforms for '{expected}'"
            remedy = "Set frame_id in the driver, or odom_frame (with tf_per_robot) of the estimator"
            yield Finding(topic.name, problem, remedy)


def _of_fixes(evidence: Evidence) -> Iterator[Finding]:
    """Fixes and aerial images that are not in `map`."""
    _, statistics, ingest = evidence.read
    for number, topic in enumerate(evidence.inputs):
        found = ingest.frame_id(number)
        if topic.kind.in_map and statistics[number].received and found != ingest.map_frame:
            problem = f"is in frame '{found}', not in '{ingest.map_frame}'"
            yield Finding(topic.name, problem, "Publish it in that frame, or set map_frame of the estimator")
