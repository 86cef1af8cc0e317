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
    """Rows and models of all tracks, for compiled code.

    Attributes:
        filled: (N,) number of rows in use.
        stamp_ns: (N, capacity) instants, calibrated for delay.
        raw: (N, capacity, 3) poses as reported, headings unwrapped.
        pose: (N, capacity, 3) calibrated poses O, headings unwrapped.
        covariance: (N, capacity, 3, 3) preintegrated to the row, see `Preintegrated`.
        jacobian: (N, capacity, 3, 3) preintegrated to the row; columns as in `estimated_parameters`.
        rate: (N, capacity, 3) calibrated velocity forward and left [m/s] and turn rate [rad/s] at the row,
            after the lag.
        twist: (N, capacity, 3) reported velocity forward, left [m/s] and turn rate [rad/s]; NaN: not known.
        agreed: (N, capacity, 2) evidence that twists agree with displacements and turns, see `fault_of_step`.
        fastest: (N, capacity, 2) largest speed [m/s] and turn rate [rad/s] of the twists so far.
        unmoved: (N, capacity, 3) displacement [m] and turn [rad] by the twists while the pose is constant;
            NaN after the pose has changed.
        known_ns: (N, capacity) end of the known motion: the row's instant, or earlier after repeated faults.
        jump_ns: (N, capacity, 2) instants of the last two faults, newest first.
        twist_from_ns: (N,) instant after which the twist is integrated; LATEST_NS: never.
        twist_until_ns: (N,) instant until which it is.
        delay_ns: (N,) delay of the stamps.
        model: (N,) of MODEL_DTYPE.
        response: (N, 2, V, W) shares of speed and of turn rate of `MotionResponse`.
        response_speed: (N, V) speeds of its grid, padded with infinity.
        response_turn_rate: (N, W) turn rates of its grid.
        begin_ns: (N,) instant of the very first row.
        begin_pose: (N, 3) pose of the very first row.
        is_stationary: (N,) True for a robot without odometry: its track stays at the origin.
        imu: (N,) of IMU_DTYPE.
        gyro_filled: (N,) number of turn rates in use.
        gyro_ns: (N, G) their instants, calibrated for delay.
        gyro_rate: (N, G) measured turn rates about the vertical [rad/s].
        gyro_angle: (N, G) their integral [rad].
        gyro_piece: (N, G) number of the pause before, beyond which nothing is integrated.
        walk: (N, 2) its variances per second of position [m^2/s] and heading [rad^2/s].
    """

    filled: IntArray
    stamp_ns: IntArray
    raw: FloatArray
    pose: FloatArray
    covariance: FloatArray
    jacobian: FloatArray
    rate: FloatArray
    twist: FloatArray
    agreed: IntArray
    fastest: FloatArray
    unmoved: FloatArray
    known_ns: IntArray
    jump_ns: IntArray
    twist_from_ns: IntArray
    twist_until_ns: IntArray
    delay_ns: IntArray
    model: NDArray[np.void]
    response: FloatArray
    response_speed: FloatArray
    response_turn_rate: FloatArray
    begin_ns: IntArray
    begin_pose: FloatArray
    is_stationary: NDArray[np.bool_]
    imu: NDArray[np.void]
    gyro_filled: IntArray
    gyro_ns: IntArray
    gyro_rate: FloatArray
    gyro_angle: FloatArray
    gyro_piece: IntArray
    walk: FloatArray
