"""Headers, mounts and places of lidars that were refused or misleading once, each with its right value."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from bench.shared.common import SHARED
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimate import Status

FOLDER = SHARED / "cases" / "replay"
_TRACKED, _ERROR_M, _MISLEADING = 0.85, 0.05, 0.001
"""Least share of tracked poses, greatest RMSE, and greatest share of misleading ones where all is right."""


def _upside_down(swarm: Swarm) -> Swarm:
    robot = swarm.robots[0]
    return replace(swarm, robots=(replace(robot, lidar=replace(robot.lidar, roll=np.pi)),))


def _is_right(_: ReplayResult, figures: Mapping[str, float]) -> bool:
    good = figures["tracked"] >= _TRACKED and figures["rmse_m"] <= _ERROR_M
    return good and figures["misleading"] <= _MISLEADING


def _is_named(word: str) -> Callable[[ReplayResult, Mapping[str, float]], bool]:
    """Poses are not misleading, and a remark has a word."""
    return lambda result, figures: (
        figures["misleading"] <= _MISLEADING and any(word in remark for remark in result.remarks)
    )


_CASES: Mapping[
    str, tuple[str, Callable[[Swarm], Swarm], Callable[[ReplayResult, Mapping[str, float]], bool]]
]
_CASES = MappingProxyType(
    {
        **{
            name: (name, lambda swarm: swarm, _is_right)
            for name in ("lidar_nothing_met_is_range_max", "lidar_count_below_angles", "lidar_beams_cropped")
        },
        "lidar_upside_down": ("lidar_upside_down", _upside_down, _is_right),
        "lidar_upside_down_undescribed": (
            "lidar_upside_down",
            lambda swarm: swarm,
            lambda result, figures: not figures["tracked"] and bool(result.losses),
        ),
        "lidar_stamped_late": ("lidar_stamped_late", lambda swarm: swarm, _is_named("set lidar.delay_s")),
        "lidar_reversed_sweep": (
            "lidar_reversed_sweep",
            lambda swarm: swarm,
            lambda *found: _is_right(*found) and _is_named("in the other order")(*found),
        ),
        "far_lidar": ("far_lidar", lambda swarm: swarm, _is_right),
    }
)
"""Name -> folder, change of its description, and whether the result is right."""


def measure() -> dict[str, float]:
    """Figures of all cases."""
    figures: dict[str, float] = {}
    for name, (folder, change, is_right) in _CASES.items():
        result = replay(FOLDER / folder, change(load_swarm(FOLDER / folder / "swarm.yaml")))
        tracked = result.status[:, 0] == Status.TRACKED
        found = {"tracked": float(tracked.mean()), "rmse_m": 0.0, "misleading": 0.0}
        errors = next(iter(result.errors.values()), None)
        if errors is not None and tracked.any():
            own = tracked[np.searchsorted(result.stamp_ns, errors.stamp_ns)]
            found["rmse_m"] = float(np.sqrt(np.mean(errors.position[own] ** 2)))
            found["misleading"] = float(errors.misleading[own].mean())
        found["right"] = float(is_right(result, found))
        figures |= {f"cases.{name}.{key}": value for key, value in found.items()}
    figures["cases.right_share"] = float(np.mean([figures[f"cases.{name}.right"] for name in _CASES]))
    return figures
