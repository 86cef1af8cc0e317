"""Ceiling cameras: twenty robots with flat markers under four overlapping cameras, from pictures to poses.

Bounds: position 0.3 cm and heading 0.5 degrees (root mean square), no jump by more than 0.3 cm when one
camera takes over from another, and all detectors and the estimator on one core. Images arrive 150 to 300 ms
late, and what the wheels slip meanwhile nobody can know. `bound` is the error of a pose that was exact in the
newest image that has arrived; `at_once` is a swarm whose images and odometry are not late.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from bench.inputs.overhead_world import ARENA, MODEL, PERIOD_NS, ROBOTS, OverheadRun, simulate_overhead
from bench.shared.common import ProgressLine, new_plot, rms, save_plot
from bench.shared.simulated_run import (
    errors_of,
    estimates_of,
    inputs_between,
    odometry_rows,
    position_rmse,
    ticks,
)
from swarm_loc_drivers.sim.run import START_NS
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.sensors.sensor import in_order_of_arrival
from swarm_loc_estimator.timeline.estimator import Status

DURATION_S = 20.0
_SETTLED_NS = 3 * 10**9  # From here on errors count
_HAND_OVER_NS = 500_000_000
"""Jumps count as those of a hand-over so long after a camera sees a robot anew or for the last time."""
_NEW_NS = 10**9  # A camera that did not see a robot for so long sees it anew


class Tracked(NamedTuple):
    """What the estimator made of a run."""

    stamp_ns: IntArray  # (K,) of ticks
    poses: FloatArray  # (K, N, 3), NaN before a robot is located
    errors: FloatArray  # (K, N, 3)
    nees: FloatArray  # (K, N)
    jumps: FloatArray  # (K, N) how far a tick moved a robot besides its odometry [m]
    hands_over: NDArray[np.bool_]  # (K, N) whether one camera has just taken over from another
    tracked: NDArray[np.bool_]  # (K, N)
    cpu_s: float  # Time that the estimator took [s]
    drops: Mapping[str, int]  # Data not used, by reason

    @property
    def counts(self) -> NDArray[np.bool_]:
        """(K, N) where errors count."""
        return self.tracked & (self.stamp_ns >= START_NS + _SETTLED_NS)[:, None]


def measure(seeds: Sequence[int], say: ProgressLine) -> dict[str, float]:
    """Run all seeds; draw the last one; return the figures."""
    runs, prompt, shares, bounds = [], [], [], []
    for seed in seeds:
        run = simulate_overhead(seed, DURATION_S, say)
        prompt.append(track(_at_once(run)))  # compiles or loads what is timed next
        found = track(run)
        runs.append(found)
        shares.append((run.cpu_s / run.images * 4e9 / PERIOD_NS, found.cpu_s / run.duration_s))
        bounds.append(_bound(run, found))
        say(f"seed {seed}: {_rms(found)[0]:.3f} cm, dropped {dict(found.drops)}")
    print()
    _draw(run, found)
    jumps = np.concatenate([one.jumps[one.counts & one.hands_over] for one in runs])
    steady = np.concatenate([one.jumps[one.counts & ~one.hands_over] for one in runs])
    detectors, estimator = np.mean(shares, axis=0)
    begun = [one.stamp_ns > START_NS + 10**9 for one in runs]
    of = {"": map(_rms, runs), "at_once.": map(_rms, prompt), "bound.": bounds}
    wrong = {name: np.sqrt(np.mean(np.square(list(values)), axis=0)) for name, values in of.items()}
    return {
        **{f"overhead.{name}position_cm": float(values[0]) for name, values in wrong.items()},
        **{f"overhead.{name}heading_deg": float(values[1]) for name, values in wrong.items()},
        "overhead.handover_jump_cm": 100.0 * float(jumps.max()),
        "overhead.handover_jump_rms_cm": 100.0 * rms(jumps),
        "overhead.other_jump_cm": 100.0 * float(steady.max()),
        "overhead.nees": float(np.mean(np.concatenate([one.nees[one.counts] for one in runs]))),
        "overhead.tracked_share": float(
            np.mean([one.tracked[some].mean() for one, some in zip(runs, begun, strict=True)])
        ),
        "overhead.detectors_share": float(detectors),
        "overhead.core_share": float(detectors + estimator),
    }


def _at_once(run: OverheadRun) -> OverheadRun:
    """The run with arrivals at the stamps."""
    odometry, seen = run.odometry.copy(), run.detections
    odometry["arrival_ns"] = odometry["stamp_ns"]
    seen = in_order_of_arrival([seen._replace(arrival_ns=seen.stamp_ns)])
    order = np.argsort(odometry["arrival_ns"], kind="stable")
    return replace(run, odometry=odometry[order], detections=seen)


def _bound(run: OverheadRun, found: Tracked) -> FloatArray:
    """Position [cm] and heading [deg], rms, of true poses in the newest arrived images, moved by odometry."""
    seen, odometry, errors = run.detections, run.odometry, []
    for robot in range(ROBOTS):
        mine = seen.detection["id"] == robot
        arrived_ns, newest_ns = seen.arrival_ns[mine], np.maximum.accumulate(seen.stamp_ns[mine])
        last = np.searchsorted(arrived_ns, found.stamp_ns, side="right") - 1
        own = odometry[odometry["robot"] == robot]
        own = own[np.argsort(own["stamp_ns"], kind="stable")]
        path = Trajectory(own["stamp_ns"].astype(np.int64), own["pose"])
        some = found.counts[:, robot] & (last >= 0) & (found.stamp_ns <= own["stamp_ns"][-1])
        now_ns, then_ns = found.stamp_ns[some], newest_ns[last[some]]
        (then, is_known), (now, _) = (interpolate(path, ns, PERIOD_NS) for ns in (then_ns, now_ns))
        moved = se2.compose(run.truth.at(robot, then_ns), se2.between(then, now))
        errors.append((moved - run.truth.at(robot, now_ns))[is_known])
    return _rms_of(np.concatenate(errors))


def track(run: OverheadRun) -> Tracked:
    """Run the estimator over a run in order of arrival, with a tick every 0.1 s."""
    ticks_ns = ticks(run)
    inputs = inputs_between(ticks_ns, odometry=odometry_rows(run), detections=run.detections)
    begun_s = time.process_time()
    estimates, (*_, estimator) = zip(*estimates_of(run.swarm, inputs, ticks_ns), strict=True)
    cpu_s = time.process_time() - begun_s
    poses, covariances, transforms = (
        np.array([one[k] for one in estimates])
        for k in (1, 2, 3)  # poses, covariances, map_to_odom
    )
    errors = errors_of(poses, run, ticks_ns)
    squared = np.full(errors.shape[:2], np.nan)
    known = np.isfinite(errors).all(axis=2)
    squared[known] = nees(errors[known], covariances[known])
    tracked = np.array([one.status for one in estimates]) == Status.TRACKED
    on_odometry = se2.between(transforms[1:], poses[1:])
    before = se2.compose(transforms[:-1], on_odometry)
    jumps = np.zeros(errors.shape[:2])
    jumps[1:] = np.linalg.norm(poses[1:, :, :2] - before[..., :2], axis=2)
    return Tracked(
        ticks_ns, poses, errors, squared, jumps, _hand_overs(run, ticks_ns), tracked, cpu_s, estimator.drops
    )


def _hand_overs(run: OverheadRun, ticks_ns: IntArray) -> NDArray[np.bool_]:
    """(K, N) ticks just after the stamps of images of a camera that sees a robot anew or for the last time.

    Only where another camera saw it within a second, too.
    """
    rows, found = run.detections, np.zeros((len(ticks_ns), ROBOTS), dtype=bool)
    for robot in range(ROBOTS):
        mine = rows.detection["id"] == robot
        stamps = [np.sort(rows.stamp_ns[mine & (rows.robot == ROBOTS + k)]) for k in range(4)]
        for camera, of_one in enumerate(stamps):
            others = np.concatenate([one for k, one in enumerate(stamps) if k != camera])
            gaps = (
                np.diff(of_one, prepend=-_NEW_NS, append=of_one[-1:].max(initial=0) + 2 * _NEW_NS) > _NEW_NS
            )
            edges = [*of_one[gaps[:-1]].tolist(), *of_one[gaps[1:]].tolist()]
            for edge_ns in edges:
                if others.size and np.abs(others - edge_ns).min() < _NEW_NS:
                    late = ticks_ns - edge_ns
                    found[(late > 0) & (late <= _HAND_OVER_NS), robot] = True
    return found


def _rms(found: Tracked) -> FloatArray:
    """Position [cm] and heading [deg], rms."""
    return _rms_of(found.errors[found.counts])


def _rms_of(errors: FloatArray) -> FloatArray:
    """Position [cm] and heading [deg], rms, of errors (k, 3)."""
    return np.array([100.0 * position_rmse(errors), math.degrees(rms(se2.wrap_angle(errors[:, 2])))])


def _draw(run: OverheadRun, found: Tracked) -> None:
    """The arena with true and estimated paths, and errors over time."""
    # the arena
    figure, (arena, errors) = new_plot(2, width=6.4, height=4.8)
    truth = run.truth.all_at(found.stamp_ns)
    for robot in range(ROBOTS):
        arena.plot(*truth[:, robot, :2].T, color="0.75", linewidth=3.0, label=None if robot else "true")
        arena.plot(*found.poses[:, robot, :2].T, linewidth=0.8, label=None if robot else "estimated")
    for camera in run.swarm.cameras:
        _outline(arena, camera.x, camera.y, camera.z)
    arena.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="four ceiling cameras")
    arena.set(xlim=(-0.55 * ARENA[0], 0.55 * ARENA[0]), ylim=(-0.55 * ARENA[1], 0.55 * ARENA[1]))
    arena.legend(loc="lower right")
    # errors over time, and jumps where another camera takes over
    seconds = (found.stamp_ns - START_NS) * 1e-9
    distance = 100.0 * np.linalg.norm(found.errors[..., :2], axis=2)
    heading = np.degrees(np.abs(found.errors[..., 2]))
    errors.plot(seconds, distance, color="0.8", linewidth=0.6)
    located = np.isfinite(distance).any(axis=1)
    seconds, distance, heading = seconds[located], distance[located], heading[located]
    errors.plot(seconds, np.sqrt(np.nanmean(distance**2, axis=1)), color="C0", label="position, rms [cm]")
    errors.plot(seconds, np.sqrt(np.nanmean(heading**2, axis=1)), color="C1", label="heading, rms [deg]")
    jumped = found.hands_over & found.counts
    at, _ = np.nonzero(jumped)
    errors.plot(
        (found.stamp_ns[at] - START_NS) * 1e-9,
        100.0 * found.jumps[jumped],
        ".",
        color="C3",
        markersize=3,
        label="hand-over jump [cm]",
    )
    errors.axhline(0.3, color="C3", linestyle=":", linewidth=1.0)
    errors.set(xlabel="time [s]", ylim=(0.0, 1.5), title="errors")
    errors.legend(loc="upper right")
    print(save_plot(figure, "inputs-overhead"))


def _outline(arena: Axes, x: float, y: float, height: float) -> None:
    """About what a camera sees of the floor."""
    half_x = height * math.tan(0.5 * MODEL.field_of_view)
    half_y = half_x * MODEL.height / MODEL.width
    corners = [(x + a * half_x, y + b * half_y) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))]
    arena.plot(*zip(*corners, strict=True), "--", color="0.4", linewidth=0.8)
