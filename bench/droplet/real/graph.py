"""Whole recordings through the estimator: who is located, how well, and whether any pose misleads.

Each recording is replayed with a board that was fitted to others; the shortest is played into the live graph
besides, by the player over DDS to the estimator's node. A robot can be seen that lit its emitters several
times within reach of a receiver, with nobody in between. Poses are held against the camera's while it saw a
robot stand; misleading is what `bench.integrity` calls so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.integrity.scoring import Estimated, Score, plot_errors, scored
from bench.shared.common import OUT, Cell, ProgressLine, table
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.launch import GraphOptions
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.calibration.infrared.board import (
    GAIN_SIGMA,
    BoardCalibration,
    BoardReadings,
    BoardRecording,
    read_board,
    without_dead,
)
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.datasets.droplets import ImportSettings, import_recording
from swarm_loc_estimator.offline.live_run import compare_with_replay, play_live
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.ir_board import IrGains, save_ir_platform
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimator import Status

LIVE_RATE = 10.0
REACH_M, MIN_EXCHANGES = 0.2, 5  # Who lit its emitters so often so near to a receiver can be seen
_STOOD_S, _STOOD_M, _STOOD_RAD = 30.0, 0.0035, np.radians(8.0)
"""Between two sightings so little apart the importer takes a robot to have stood."""


@dataclass(frozen=True)
class Outcome:
    """A recording through the estimator."""

    score: Score  # As `bench.integrity` has it, of the instants with truth
    located_share: float  # Share of the robots that can be seen that were located at all
    tracked_share: float  # Share of all robots' instants that were told as tracked, with truth or without
    position_cm: FloatArray  # (K,) errors of the poses told as tracked whose truth is known
    heading_deg: FloatArray  # (K,) likewise, without sign; NaN where it is told as unknown

    @property
    def figures(self) -> dict[str, float]:
        """By their names."""
        return {
            "located_share": self.located_share,
            "tracked_share": self.tracked_share,
            "position_cm": float(np.median(self.position_cm)),
            "position_p90_cm": float(np.quantile(self.position_cm, 0.9)),
            "heading_known_share": float(np.isfinite(self.heading_deg).mean()),
            "heading_deg": float(np.nanmedian(self.heading_deg)),
            "nees": self.score.nees,
            "misleading_share": self.score.misleading_share,
        }


def measure(tests: list[tuple[Recorded, BoardCalibration]], names: list[str]) -> dict[str, float]:
    """Take recordings, each with the board to believe in, through the estimator; returns figures."""
    outcomes: dict[str, Outcome] = {}
    figures: dict[str, float] = {}
    shortest = min(tests, key=lambda test: len(test[0].data.stamp_ns))[0]
    for recorded, done in tests:
        said, name = ProgressLine(f"graph: {recorded.name}"), recorded.name.rsplit("_", 1)[-1]
        said("replay")
        swarm_file = described(recorded, done, names)
        yaw = dict(zip(names, done.model.truth_yaw.tolist(), strict=True))
        seen = can_be_seen(recorded, names)
        result = replay(recorded.bag, load_swarm(swarm_file))
        outcomes[name] = outcome_of(result, yaw, seen)
        if recorded is shortest:
            said("live")
            outcomes[f"{name}.live"], agreement = lived(recorded, swarm_file, yaw, seen)
            figures |= {f"graph.{name}.live.{key}": value for key, value in agreement.items()}
        print()
    report(outcomes, figures)
    for name, outcome in outcomes.items():
        figures |= {f"graph.{name}.{key}": value for key, value in outcome.figures.items()}
    return figures


def report(outcomes: dict[str, Outcome], agreement: dict[str, float]) -> None:
    """Print the table, and how far live poses are from those of the replay; draw."""
    rows: list[list[Cell]] = [[name, *one.figures.values()] for name, one in outcomes.items()]
    head = ["graph", "located", "tracked", "cm", "90 % cm", "heading known", "deg", "NEES", "misleading"]
    print(table(head, rows))
    print(table(["live beside replay", ""], [[name, value] for name, value in agreement.items()]))
    print(f"plot: {plot_errors({name: [one.score] for name, one in outcomes.items()}, 'droplet_real')}")


def described(recorded: Recorded, done: BoardCalibration, names: list[str]) -> Path:
    """Write the swarm with a board, gains and dead elements beside the bag; returns the file.

    Dead elements are found in the recording itself, from all exchanges: truth tells which pairs are clear.
    """
    folder = recorded.bag.parent
    board = folder / f"{recorded.name}_board.yaml"
    save_ir_platform(done.model.platform, board)
    elements, _ = without_dead(done.model.platform, recorded.data, len(names))
    robots = []
    for robot in recorded.swarm.robots:
        if robot.ir is None:
            continue
        ir = replace(robot.ir, platform=done.model.platform, source=str(board))
        if robot.name in names:
            place = names.index(robot.name)
            sensors, emitters = elements.numbers(place)
            ir = replace(ir, gains=_gains(done, place), dead_sensors=sensors, dead_emitters=emitters)
        robots.append(replace(robot, ir=ir))
    path = folder / f"{recorded.name}_swarm.yaml"
    save_swarm(Swarm(tuple(robots)), path)
    return path


def _gains(done: BoardCalibration, place: int) -> IrGains | None:
    """What the fit found of a robot's sensors."""
    factors = done.model.sensor_gains[place]
    if not done.with_gains or np.all(factors == 1.0):
        return None
    found = tuple(np.clip(factors, 0.05, 20.0).round(4).tolist())
    return IrGains(found, (1.0,) * len(found), GAIN_SIGMA)


def can_be_seen(recorded: Recorded, names: list[str]) -> set[str]:
    """Receivers, and who lit its emitters several times near one of them with nobody in between."""
    near = select(recorded.clear, recorded.clear.poses[:, 0] < REACH_M)
    often = np.bincount(near.transmitter, minlength=len(names)) >= MIN_EXCHANGES
    often[near.receiver] = True
    return {names[place] for place in np.flatnonzero(often)}


def outcome_of(result: ReplayResult, yaw: dict[str, float], seen: set[str]) -> Outcome:
    """Hold poses against the truth of robots whose headings are ahead of it by `yaw` [rad]."""
    error = np.full(result.poses.shape, np.nan)
    tracked = np.zeros(error.shape[:2], dtype=np.bool_)
    robots = result.swarm.robots
    for index, robot in enumerate(robots):
        if robot.name in result.truth:
            there, known = standing(result.truth[robot.name], result.stamp_ns)
            error[known, index] = result.poses[known, index] - there[known]
            error[known, index, 2] -= yaw.get(robot.name, 0.0)
            tracked[:, index] = known
    error[..., 2] = wrap_angle(error[..., 2])
    tracked &= result.status == Status.TRACKED
    time_s: FloatArray = (result.stamp_ns - result.stamp_ns[0]).astype(np.float64) * 1e-9
    estimated = Estimated(time_s, error, result.covariances, tracked)
    located = [
        np.isfinite(result.poses[:, k]).all(axis=1).any() for k, r in enumerate(robots) if r.name in seen
    ]
    told, known = error[tracked], result.heading_known[tracked]
    return Outcome(
        scored(estimated),
        float(np.mean(located)),
        float(np.mean(result.status == Status.TRACKED)),
        100.0 * np.hypot(told[:, 0], told[:, 1]),
        np.where(known, np.degrees(np.abs(told[:, 2])), np.nan),
    )


def standing(truth: Trajectory, stamp_ns: IntArray) -> tuple[FloatArray, BoolArray]:
    """Where a robot stood at some instants (T,), and whether the camera saw it stand then."""
    places, known = interpolate(truth, stamp_ns, round(_STOOD_S * 1e9))
    after = np.clip(np.searchsorted(truth.stamp_ns, stamp_ns), 1, max(len(truth.stamp_ns) - 1, 1))
    after = np.minimum(after, len(truth.stamp_ns) - 1)
    moved = truth.pose[after] - truth.pose[np.maximum(after - 1, 0)]
    stood = (np.hypot(moved[:, 0], moved[:, 1]) < _STOOD_M) & (np.abs(wrap_angle(moved[:, 2])) < _STOOD_RAD)
    return places, known & stood


def lived(
    recorded: Recorded, swarm_file: Path, yaw: dict[str, float], seen: set[str]
) -> tuple[Outcome, dict[str, float]]:
    """Play a recording into the live graph; also how far its poses are from those of a replay."""
    options = GraphOptions(str(swarm_file), bag=str(recorded.bag), rate=LIVE_RATE)
    live = play_live(options, log=OUT / "droplet_real" / f"{recorded.name}.log")
    compared = compare_with_replay(live, recorded.bag)
    return outcome_of(live.result, yaw, seen), {
        "difference_rms_m": compared.rms_m,
        "equal_share": compared.equal_share,
        "located_by_one_share": float(np.mean(np.isinf(compared.distance_m))),
        "lost_messages": float(live.lost),
    }


@dataclass(frozen=True)
class Recorded:
    """A recording whose robots are numbered across all recordings."""

    name: str  # Of the file, without its ending
    bag: Path  # What it was imported to
    swarm: Swarm  # As the importer describes it
    data: BoardReadings  # All exchanges whose poses are known
    clear: BoardReadings  # Those of them with nobody in between


def read_folder(folder: Path, names: list[str], work: Path) -> list[Recorded]:
    """All recordings of a folder as bags in `work`; robots that are new are added to the names.

    Raises:
        UserError: There is none.
    """
    paths = sorted(folder.glob("*.txt"))
    if not paths:
        raise UserError(f"'{folder}' holds no recording (*.txt).")
    work.mkdir()
    recordings = []
    for path in paths:
        progress, bag = ProgressLine(path.name), work / path.stem
        done = import_recording(path, bag, ImportSettings(), lambda _, what, p=progress: p(what))  # type: ignore[misc]
        swarm = load_swarm(bag / "swarm.yaml")
        board = read_board(read_recording(bag, swarm), swarm)
        print(
            f"\r{path.name}: {done.exchanges} exchanges, {done.with_truth} with truth;"
            f" {' '.join(done.remarks)}"
        )
        data = _numbered(board, swarm, names)
        recordings.append(Recorded(path.stem, bag, swarm, data, select(data, board.clear)))
    return recordings


def _numbered(board: BoardRecording, swarm: Swarm, names: list[str]) -> BoardReadings:
    """All exchanges, by the places of robots in `names`, to which new ones are added."""
    of_robot = []
    for index in board.robots:
        name = swarm.robots[index].name
        if name not in names:
            names.append(name)
        of_robot.append(names.index(name))
    numbers = np.array(of_robot)
    data = board.data
    return data._replace(receiver=numbers[data.receiver], transmitter=numbers[data.transmitter])
