"""Rows and models of odometry tracks, as arrays for compiled code."""

from __future__ import annotations

from dataclasses import fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.swarm.error_models import ImuModel, OdometryModel

BEFORE_ALL_NS, LATEST_NS = np.iinfo(np.int64).min, np.iinfo(np.int64).max

MODEL_DTYPE = np.dtype([(f.name, np.float64) for f in fields(OdometryModel)])
"""Record of the numbers of an `OdometryModel`."""
IMU_DTYPE = np.dtype([(f.name, np.float64) for f in fields(ImuModel)])
"""Record of the numbers of an `ImuModel`."""


class TrackArrays(NamedTuple):
    """Rows and models of all tracks, for compiled code."""

    filled: IntArray  # (N,) number of rows in use
    stamp_ns: IntArray  # (N, capacity) instants, calibrated for delay
    raw: FloatArray  # (N, capacity, 3) poses as reported, headings unwrapped
    pose: FloatArray  # (N, capacity, 3) calibrated poses O, headings unwrapped
    covariance: FloatArray  # (N, capacity, 3, 3) preintegrated to the row, see `Preintegrated`
    jacobian: FloatArray  # (N, capacity, 3, 3) preintegrated to the row; columns as in `estimated_parameters`
    # (N, capacity, 3) calibrated velocity forward and left [m/s] and turn rate [rad/s] at the row, after the
    # lag
    rate: FloatArray
    # (N, capacity, 3) reported velocity forward, left [m/s] and turn rate [rad/s]; NaN: not known
    twist: FloatArray
    # (N, capacity, 2) evidence that twists agree with displacements and turns, see `fault_of_step`
    agreed: IntArray
    fastest: FloatArray  # (N, capacity, 2) largest speed [m/s] and turn rate [rad/s] of the twists so far
    # (N, capacity, 3) displacement [m] and turn [rad] by the twists while the pose is constant; NaN after the
    # pose has changed
    unmoved: FloatArray
    # (N, capacity) end of the known motion: the row's instant, or earlier after repeated faults
    known_ns: IntArray
    jump_ns: IntArray  # (N, capacity, 2) instants of the last two faults, newest first
    twist_from_ns: IntArray  # (N,) instant after which the twist is integrated; LATEST_NS: never
    twist_until_ns: IntArray  # (N,) instant until which it is
    delay_ns: IntArray  # (N,) delay of the stamps
    model: NDArray[np.void]  # (N,) of MODEL_DTYPE
    response: FloatArray  # (N, 2, V, W) shares of speed and of turn rate of `MotionResponse`
    response_speed: FloatArray  # (N, V) speeds of its grid, padded with infinity
    response_turn_rate: FloatArray  # (N, W) turn rates of its grid
    begin_ns: IntArray  # (N,) instant of the very first row
    begin_pose: FloatArray  # (N, 3) pose of the very first row
    is_stationary: NDArray[np.bool_]  # (N,) True for a robot without odometry: its track stays at the origin
    imu: NDArray[np.void]  # (N,) of IMU_DTYPE
    gyro_filled: IntArray  # (N,) number of turn rates in use
    gyro_ns: IntArray  # (N, G) their instants, calibrated for delay
    gyro_rate: FloatArray  # (N, G) measured turn rates about the vertical [rad/s]
    gyro_angle: FloatArray  # (N, G) their integral [rad]
    gyro_piece: IntArray  # (N, G) number of the pause before, beyond which nothing is integrated
    walk: FloatArray  # (N, 2) its variances per second of position [m^2/s] and heading [rad^2/s]
