"""One simulated exploration, and how good its map and poses are."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from bench.pushbot.exploration import Arrival, Exploration, PushBotNoise
from bench.pushbot.lidar import LidarDrive
from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlan, floor_plan
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import fix_covariance
from swarm_loc_estimator.offline.metrics import is_misleading, nees

DIVERGED_CM = 30.0
GOOD_CM, GOOD_DEG = 10.0, 2.0
COVERED_M = 0.06  # A piece of wall is covered if a cell so near is occupied
COVERED_SHARE = 0.9
_LOOK_EVERY_S = 10.0
_UNREPORTED_SIGMAS = 3.0


@dataclass(frozen=True)
class RunSettings:
    """One run."""

    plan: str  # Name of the floor plan
    slip: float  # Share of turns that wheels lose
    seed: int  # Of all noise
    minutes: float = 20.0  # How long
    robots: int = 1  # How many
    pixel: float = 0.1  # Noise of the tracker [px]
    lights: bool = True  # Whether LEDs of other robots are seen
    checks_covariances: bool = False  # Whether poses are compared with their covariances at each arrival
    # Whether the robot has a lidar, see `bench.pushbot.lidar`, in place of a laser pointer
    lidar: bool = False


@dataclass(frozen=True)
class RunResult:
    """The result of a run; errors are against the truth, in the frame of the first robot's start."""

    settings: RunSettings  # Of the run
    position_cm: float  # Error of the robots' last poses, mean over the robots
    heading_deg: float  # Error of their headings, mean over the robots
    worst_cm: float  # Largest error of any pose after the last solution
    online_position_cm: float  # Median error of poses when they were published
    online_worst_cm: float  # The largest of these
    aligned_cm: float  # RMS error of all poses after one rigid fit
    wall_cm: float  # Mean distance of occupied cells from a wall
    wall_aligned_cm: float  # The same after the fit
    coverage: float  # Share of walls with an occupied cell nearby
    coverage_90_s: float  # When this was nine tenths, as published then and after the fit; NaN: never
    cpu_s_per_s: float  # Time that mapping took, per second
    bumps: int  # How often a robot hit something
    cells: FloatArray  # (n, 2) occupied cells [m]
    path: FloatArray  # (m, 3) robot, x, y of all poses [m]
    # Share of poses off by more than 5 sigma and 2 cm when published; NaN: not compared
    misleading_share: float = math.nan
    diverged_unreported: float = 0.0  # 1 if one was off by more than `DIVERGED_CM` and 3 sigma, else 0
    sweep_ms: float = math.nan  # CPU time per sweep of a lidar [ms]; NaN: it has none

    @property
    def is_diverged(self) -> bool:
        """Whether any pose was off by more than `DIVERGED_CM` after the last solution."""
        return not self.worst_cm <= DIVERGED_CM

    @property
    def is_diverged_online(self) -> bool:
        """Whether any pose was off by more than that when it was published."""
        return not self.online_worst_cm <= DIVERGED_CM

    @property
    def is_good(self) -> bool:
        """Whether the last poses are within `GOOD_CM` and `GOOD_DEG`."""
        return self.position_cm <= GOOD_CM and self.heading_deg <= GOOD_DEG


def run(settings: RunSettings) -> RunResult:
    """Simulate and score one run."""
    plan = floor_plan(settings.plan)
    rng = np.random.default_rng([settings.seed, round(1e3 * settings.slip), settings.robots])
    if settings.lidar:
        return _run_lidar(settings, plan, rng)
    mapper = CooperativeMapper()
    exploration = Exploration(plan, mapper, rng, use_lights=settings.lights)
    for number in range(settings.robots):
        share = 1.0 if settings.robots == 1 else 0.5 + 0.5 * number / (settings.robots - 1)
        exploration.join(PushBotNoise(slip=settings.slip * share, pixel=settings.pixel))
    places: list[tuple[int, float]] = []
    covariances: list[FloatArray] = []
    covered = _Covered(plan, mapper)

    def note(arrival: Arrival) -> None:
        places.append(_place(mapper, arrival))
        if settings.checks_covariances:
            covariances.append(fix_covariance(mapper.covariance(arrival.robot)))
        covered.look(arrival.time_s)

    exploration.run(60.0 * settings.minutes, note)
    mapper.finish()
    found = _score(settings, plan, exploration, mapper, _final(mapper, places), covered.since_s)
    return _compared(found, exploration, np.array(covariances)) if covariances else found


def _run_lidar(settings: RunSettings, plan: FloorPlan, rng: np.random.Generator) -> RunResult:
    """A run of a robot with a lidar; its arrivals are the sweeps in the graph."""
    mapper = CooperativeMapper()
    drive = LidarDrive.starting(plan, mapper, settings.slip, rng)
    drive.run(60.0 * settings.minutes)
    mapper.finish()
    final = mapper.graph.poses[: len(drive.arrivals)].copy()
    found = _score(settings, plan, drive, mapper, final, math.nan)
    return replace(found, sweep_ms=1e3 * drive.cpu_s / drive.sweeps)


def _compared(result: RunResult, exploration: Exploration, covariances: FloatArray) -> RunResult:
    """A result with the poses (n,) of all arrivals compared with their covariances (n, 3, 3)."""
    error = np.array([one.online - one.truth for one in exploration.arrivals])
    far = 100.0 * np.hypot(error[:, 0], error[:, 1]) > DIVERGED_CM
    unreported = far & (nees(error[:, :2], covariances[:, :2, :2]) > _UNREPORTED_SIGMAS**2)
    return replace(
        result,
        misleading_share=float(is_misleading(error, covariances).mean()),
        diverged_unreported=float(unreported.any()),
    )


class _Covered:
    """Looks now and then whether walls are covered."""

    def __init__(self, plan: FloorPlan, mapper: CooperativeMapper) -> None:
        self._mapper = mapper
        self._points = wall_points(plan, 0.04)
        self._next_s = 0.0
        self.since_s = math.nan

    def look(self, time_s: float) -> None:
        if time_s < self._next_s or not math.isnan(self.since_s):
            return
        self._next_s = time_s + _LOOK_EVERY_S
        occupancy = self._mapper.occupancy()
        if coverage(occupancy.centres(occupancy.occupied), self._points) >= COVERED_SHARE:
            self.since_s = time_s


def wall_points(plan: FloorPlan, spacing: float) -> FloatArray:
    """Points (P, 2) [m] in the middle of equal pieces of the walls, at most `spacing` long."""
    pieces = []
    for x0, y0, x1, y1 in plan.walls:
        count = max(1, int(np.ceil(np.hypot(x1 - x0, y1 - y0) / spacing)))
        share = ((np.arange(count) + 0.5) / count)[:, None]
        pieces.append(np.array([x0, y0]) + share * np.array([x1 - x0, y1 - y0]))
    return np.concatenate(pieces)


def coverage(cells: FloatArray, points: FloatArray) -> float:
    """Share of points (p, 2) of walls with a cell (n, 2) nearby."""
    return float((cKDTree(cells).query(points)[0] < COVERED_M).mean()) if len(cells) else 0.0


def wall_distance_cm(cells: FloatArray, plan: FloorPlan) -> float:
    """Mean distance of cells (n, 2) from the nearest wall [cm]."""
    return 100.0 * float(cKDTree(wall_points(plan, 0.01)).query(cells)[0].mean()) if len(cells) else math.inf


def _place(mapper: CooperativeMapper, arrival: Arrival) -> tuple[int, float]:
    """Stop of an arrival in the graph, and the turn by odometry there until now."""
    track = mapper.tracks[arrival.robot]
    if track.node is None:
        raise RuntimeError("a robot has looked around and yet is not in the graph")
    return track.node, track.stop.turn[-1] - track.stop.begin_turn if track.stop and track.is_known else 0.0


def _final(mapper: CooperativeMapper, places: list[tuple[int, float]]) -> FloatArray:
    """Poses (n, 3) of all arrivals as the mapper believes in the end."""
    nodes, turns = np.array([node for node, _ in places]), np.array([turn for _, turn in places])
    poses: FloatArray = mapper.graph.states[nodes, :3].copy()
    poses[:, 2] += mapper.graph.states[nodes, 3] * turns
    return poses


def _score(
    settings: RunSettings,
    plan: FloorPlan,
    exploration: Exploration | LidarDrive,
    mapper: CooperativeMapper,
    final: FloatArray,
    coverage_90_s: float,
) -> RunResult:
    arrivals = exploration.arrivals
    truth, online = np.array([one.truth for one in arrivals]), np.array([one.online for one in arrivals])
    robots = np.array([one.robot for one in arrivals])
    errors, online_errors = (100.0 * np.hypot(*(poses - truth)[:, :2].T) for poses in (final, online))
    last = [int(np.flatnonzero(robots == robot)[-1]) for robot in exploration.robots]
    heading = np.degrees(np.abs(se2.wrap_angle(final[last, 2] - truth[last, 2])))
    fit = se2.rigid_fit(final[:, :2], truth[:, :2])
    aligned = se2.transform_points(fit, final[:, :2]) - truth[:, :2]
    occupancy = mapper.occupancy()
    cells = occupancy.centres(occupancy.occupied)
    return RunResult(
        settings=settings,
        position_cm=float(errors[last].mean()),
        heading_deg=float(heading.mean()),
        worst_cm=float(errors.max()),
        online_position_cm=float(np.median(online_errors)),
        online_worst_cm=float(online_errors.max()),
        aligned_cm=100.0 * float(np.sqrt(np.square(aligned).sum(axis=1).mean())),
        wall_cm=wall_distance_cm(cells, plan),
        wall_aligned_cm=wall_distance_cm(se2.transform_points(fit, cells), plan),
        coverage=coverage(cells, wall_points(plan, 0.04)),
        coverage_90_s=coverage_90_s,
        cpu_s_per_s=exploration.cpu_s / (60.0 * settings.minutes),
        bumps=sum(one.bumps for one in exploration.robots.values()),
        cells=cells,
        path=np.column_stack([robots, final[:, :2]]),
    )
