"""Errors in tasks of an executor, such as ticks in simulated time and the handling of QoS events."""

from __future__ import annotations

import traceback

from rclpy.task import Task


def end_at_task_errors() -> None:
    """From now on, an error in a task of this process is printed and ends whoever spins, by SystemExit.

    The EventsExecutor of Jazzy crashes where it would tell of it, and nothing is told (ros2/rclpy#1641).
    """
    Task.set_exception = _end


def _end(_task: Task, error: Exception) -> None:
    traceback.print_exception(error)
    raise SystemExit(1) from error
