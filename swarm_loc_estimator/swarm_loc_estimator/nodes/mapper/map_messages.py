"""Messages of the mapper: grids, goals, fixes."""

from __future__ import annotations

import array

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.time import Time
from std_msgs.msg import Header

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.planar import PLANE, planar_covariance
from swarm_loc_estimator.mapping.exploration import Goal
from swarm_loc_estimator.mapping.grid import OccupancyMap


def occupancy_message(occupancy: OccupancyMap, header: Header) -> OccupancyGrid:
    """The map: -1 unknown, else the probability that a cell is occupied [%]."""
    return _grid(occupancy, occupancy.percent, header)


def visitation_message(occupancy: OccupancyMap, visits: IntArray, header: Header) -> OccupancyGrid:
    """How often robots were on each cell, 100 at most."""
    return _grid(occupancy, np.minimum(visits, 100).astype(float), header)


def _grid(occupancy: OccupancyMap, values: FloatArray, header: Header) -> OccupancyGrid:
    message = OccupancyGrid(header=header)
    message.info.map_load_time = header.stamp
    message.info.resolution = occupancy.cell
    message.info.width, message.info.height = values.shape
    message.info.origin.position.x, message.info.origin.position.y = map(float, occupancy.corner)
    message.info.origin.orientation.w = 1.0
    message.data = array.array("b", np.ascontiguousarray(np.round(values).astype(np.int8).T).tobytes())
    return message


def goal_message(goal: Goal, frame: str) -> PoseStamped:
    """Where a robot should stop, facing as it comes from where it is."""
    message = PoseStamped()
    message.header.frame_id = frame
    message.header.stamp = Time(nanoseconds=goal.stamp_ns).to_msg()
    way = goal.position - goal.pose[:2]
    _set_pose(message.pose, np.array([*goal.position, np.arctan2(way[1], way[0])]))
    return message


def fix_message(goal: Goal, covariance: FloatArray, frame: str) -> PoseWithCovarianceStamped:
    """Where a robot was when its goal was decided, with a covariance (3, 3); see `FixCovariances`."""
    message = PoseWithCovarianceStamped()
    message.header.frame_id = frame
    message.header.stamp = Time(nanoseconds=goal.stamp_ns).to_msg()
    _set_pose(message.pose.pose, goal.pose)
    full = planar_covariance(0.0, 0.0, 0.0)
    full[PLANE] = covariance
    message.pose.covariance = full.ravel()
    return message


def _set_pose(pose: object, planar: FloatArray) -> None:
    position, orientation = pose.position, pose.orientation  # type: ignore[attr-defined]  # geometry_msgs/Pose
    position.x, position.y = float(planar[0]), float(planar[1])
    orientation.z, orientation.w = float(np.sin(0.5 * planar[2])), float(np.cos(0.5 * planar[2]))
