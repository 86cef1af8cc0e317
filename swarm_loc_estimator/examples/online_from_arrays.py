"""Estimate online from arrays: odometry, UWB ranges and marker detections, five seconds at a time.

A robot drives a circle among four anchors and a marker. Its wheels report 2 % too far; its start is unknown.
"""

import numpy as np

from swarm_loc_estimator import Anchor, CameraMount, Estimator, Landmark, Robot, Swarm, UwbDevice

# A robot with a radio (address 1) and a camera, anchors (10 to 13), and a marker (7) on a wall.
anchors = {10: (-1.0, -1.0), 11: (3.0, -1.0), 12: (3.0, 3.0), 13: (-1.0, 3.0)}
swarm = Swarm(
    robots=(Robot("r1", camera=CameraMount(), uwb=UwbDevice(1, range_sigma=0.05)),),
    landmarks=(Landmark(7, x=3.0, y=1.0, yaw=np.pi),),
    anchors=tuple(Anchor(address, *place) for address, place in anchors.items()),
)
estimator, rng = Estimator(swarm), np.random.default_rng(1)

for now_s in np.arange(5.0, 61.0, 5.0):
    # What the sensors measure: a circle of 1 m about (1, 1).
    t = np.arange(now_s - 5.0, now_s, 0.05)
    yaw = 0.2 * t
    x, y = 1.0 + np.sin(yaw), 1.0 - np.cos(yaw)
    driven = np.column_stack([1.02 * np.sin(yaw), 1.02 * (1.0 - np.cos(yaw)), yaw])  # in its own frame
    address = rng.choice(list(anchors), t.size)
    anchor_x, anchor_y = np.array([anchors[one] for one in address]).T
    distance = np.hypot(anchor_x - x, anchor_y - y) + rng.normal(0.0, 0.05, t.size)
    forward = np.cos(yaw) * (3.0 - x) + np.sin(yaw) * (1.0 - y)
    right = np.sin(yaw) * (3.0 - x) - np.cos(yaw) * (1.0 - y)
    seen = forward > 0.5

    # One call takes them all: columns by the names of sensors. Numbers stand for whole columns.
    estimate, dropped = estimator.step(
        now_s,
        odometry={"robot": "r1", "stamp_s": t, "pose": driven},
        ranges={"robot": "r1", "stamp_s": t, "device": address, "range": distance},
        detections={
            "robot": "r1",
            "stamp_s": t[seen],
            "id": 7,
            "position": np.column_stack([right, 0.0 * t, forward])[seen],  # in the camera's optical frame
        },
    )
    truth = 1.0 + np.sin(0.2 * now_s), 1.0 - np.cos(0.2 * now_s)
    error = np.hypot(*(estimate.poses[0, :2] - truth))
    sigma = np.sqrt(estimate.covariances[0, 0, 0] + estimate.covariances[0, 1, 1])
    print(f"{now_s:4.0f} s  error {100.0 * error:5.2f} cm of {100.0 * sigma:5.2f}  dropped {dropped}")
