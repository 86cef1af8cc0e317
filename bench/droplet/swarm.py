"""A swarm of 20 Droplets on a table, 2 of them seen by a tracker, all others located by infrared alone.

    make bench-droplet ARGS="--live 2 --replays 8"

Nobody's start is known, every element has a gain of its own (10 %), steps are longer or shorter than the
robots believe (8 %), every other robot wanders. "live" is the whole graph: emulated firmware on
pseudo-terminals, drivers, DDS, the estimator node. "replay" is the same swarm as a bag, matrices 150-300 ms
late and one in twenty lost, through the estimator's core; "calibrated" is a replay with gains that were found
without ground truth (`calibrate_ir`) in another minute of the same robots. Errors are those of poses from a
time on when the swarm has found itself.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray

from bench.scenarios.bags import write_droplet_bag
from bench.scenarios.droplets_run import (
    FIXED,
    TURN_S,
    DropletRunSettings,
    describe_droplets,
    simulate_droplets,
)
from bench.shared.bags import read_truth
from bench.shared.common import OUT, new_plot, save_plot, table
from swarm_loc_drivers.sim.scenarios.droplets import starts
from swarm_loc_estimator.common.launch import NodeSpec, ParameterValue
from swarm_loc_estimator.offline.calibration.infrared.gains import calibrate_infrared
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.live_run import START_PATIENCE_S, LiveGraph, read_poses
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm

ROBOTS = 20
DURATION_S, SETTLED_S = 90.0, 45.0
CALIBRATED, CALIBRATION_S = 3, 60.0  # So many of the bags are replayed once more, calibrated
_ELSEWHERE = 1000
WORLD = "d1"
DRIVER_PROCESSES = 2
_SILENCE_PATIENCE_S = 60.0


@dataclass(frozen=True)
class Outcome:
    """Mean errors of one run."""

    name: str  # Of the run
    position_cm: float  # [cm]
    heading_deg: float  # [deg]
    nees: float  # Ideally 3
    worst_cm: float  # Largest error of a position [cm]
    located_s: float  # When the last robot was located, from the start [s]
    located: float  # Share of poses that there are


def outcome_of(result: ReplayResult) -> Outcome:
    """Mean errors from when the swarm should have settled."""
    begin_ns = int(result.stamp_ns[0])
    known: NDArray[np.bool_] = np.asarray(np.isfinite(result.poses).all(axis=-1))
    since_s = (result.stamp_ns - begin_ns) * 1e-9
    first_s = [float(since_s[known[:, robot]].min(initial=np.inf)) for robot in range(known.shape[1])]
    settled = result.stamp_ns >= begin_ns + SETTLED_S * 1e9
    whole = result.select(settled).overall
    return Outcome(
        result.title,
        100.0 * whole.position_mean,
        float(np.degrees(whole.heading_mean)),
        whole.nees,
        100.0 * whole.position_max,
        max(first_s),
        float(known[settled].mean()),
    )


def replayed(seed: int, folder: Path) -> ReplayResult:
    """The swarm as a bag through the estimator's core."""
    bag = _bag(folder / f"replay{seed}", seed, DURATION_S)
    return replace(replay(bag, load_swarm(bag / "swarm.yaml")), title=f"replay {seed}")


def replayed_calibrated(seed: int, folder: Path) -> ReplayResult:
    """The same bag, its robots calibrated from another one."""
    other = _bag(folder / f"calibration{seed}", seed, CALIBRATION_S, seed + _ELSEWHERE)
    swarm = load_swarm(other / "swarm.yaml")
    recording = read_recording(other, swarm)
    done = calibrate_infrared(recording, swarm, lambda _share, _what: None, with_truth=False)
    return replace(replay(folder / f"replay{seed}", done.swarm), title=f"replay {seed} calibrated")


def _bag(folder: Path, boards: int, duration_s: float, seed: int | None = None) -> Path:
    """A bag of robots with such boards, whose motion another seed may fix."""
    motion = boards if seed is None else seed
    settings = DropletRunSettings(motion, duration_s, ROBOTS, WORLD, boards=boards)
    write_droplet_bag(simulate_droplets(settings), folder, "Of the benchmark.", motion)
    return folder


def lived(seed: int, folder: Path, log: Path) -> ReplayResult:
    """The swarm in the whole graph."""
    known_swarm = _write_swarms(seed, folder)
    truth: dict[str, list[bytes]] = {robot.name: [] for robot in known_swarm.robots}
    with LiveGraph(_nodes(seed, folder, known_swarm), log) as graph:
        recorder = graph.recorder
        for name, messages in truth.items():
            keep = partial(list.append, messages)
            recorder.create_subscription(PoseStamped, f"{name}/ground_truth", keep, 100, raw=True)
        graph.wait_for(lambda: bool(recorder.raw), "publish poses", START_PATIENCE_S)
        begin_ns = read_poses(recorder.raw[0]).stamp_ns
        told = [0.0]

        def is_over() -> bool:
            """Whether enough time has passed; tell how far it is now and then."""
            now_s = (read_poses(recorder.raw[-1]).stamp_ns - begin_ns) * 1e-9
            if now_s > told[0] + 5.0:
                told[0] = now_s
                print(f"\rlive {seed}: {now_s:.0f} of {DURATION_S:.0f} s", end="", flush=True)
            return now_s >= DURATION_S

        graph.wait_for(is_over, "go on publishing poses", _SILENCE_PATIENCE_S)
        print()
    tracks = read_truth(known_swarm, truth)
    return recorder.result(f"live {seed}", known_swarm, tracks)


def _write_swarms(seed: int, folder: Path) -> Swarm:
    """Write the swarm as the world knows it, and as the estimator does, which is returned: without starts."""
    for known, name in ((True, "world.yaml"), (False, "swarm.yaml")):
        settings = DropletRunSettings(seed, robots=ROBOTS, start_known=known)
        swarm = describe_droplets(settings, starts(settings.seed, settings.robots))
        save_swarm(swarm, folder / name)
    return swarm


def _nodes(seed: int, folder: Path, swarm: Swarm) -> list[NodeSpec]:
    """Estimator, world, drivers and steering."""
    drivers = "swarm_loc_drivers"
    time: dict[str, ParameterValue] = {"use_sim_time": True}
    known: dict[str, ParameterValue] = {"swarm_file": str(folder / "swarm.yaml"), **time}
    real: dict[str, ParameterValue] = {"swarm_file": str(folder / "world.yaml"), "seed": seed}
    fixed = [swarm.robots[robot].name for robot in FIXED]
    world: dict[str, ParameterValue] = {**real, "link_folder": str(folder), "world": WORLD, "fixed": fixed}
    table: dict[str, ParameterValue] = {
        **known,
        "link_folder": str(folder),
        "parts": DRIVER_PROCESSES,
        "turn_s": TURN_S,
    }
    return [
        NodeSpec("swarm_loc_estimator", "estimator_node", "estimator", parameters=known),
        NodeSpec(drivers, "droplet_world_node", "droplet_world", parameters=world),
        *(
            NodeSpec(drivers, "droplet_fleet_node", f"table{part}", parameters={**table, "part": part})
            for part in range(DRIVER_PROCESSES)
        ),
        NodeSpec(drivers, "droplet_steering_node", "steering", parameters={**real, **time}),
    ]


def measure(live: Sequence[int], replays: Sequence[int]) -> dict[str, float]:
    """Run the swarm live and as bags, print a table, draw, and return the figures.

    Args:
        live: Seeds of the runs over the whole graph.
        replays: Seeds of the bags.
    """
    results: list[ReplayResult] = []
    with tempfile.TemporaryDirectory() as work:
        for seed in live:
            folder = Path(work) / f"live{seed}"
            folder.mkdir()
            results.append(lived(seed, folder, OUT / "droplet_swarm" / f"live{seed}.log"))
        for seed in replays:
            results.append(replayed(seed, Path(work)))
            print(f"\rreplay {seed} of {len(replays)}", end="", flush=True)
        for seed in replays[:CALIBRATED]:
            results.append(replayed_calibrated(seed, Path(work)))
            print(f"\rreplay {seed}, calibrated", end="", flush=True)
    print()
    outcomes = [outcome_of(result) for result in results]
    names = [field.name for field in fields(Outcome)]
    print(table(names, [[getattr(one, name) for name in names] for one in outcomes]))
    print(f"plot: {draw(results[0])}")
    plain = len(live) + len(replays)
    return figures_of(outcomes[: len(live)], outcomes[len(live) : plain], outcomes[plain:])


def figures_of(
    live: Sequence[Outcome], replays: Sequence[Outcome], calibrated: Sequence[Outcome]
) -> dict[str, float]:
    """Means over the runs; those of the whole graph where there are any."""
    figures: dict[str, float] = {}
    for prefix, ones in (
        ("swarm20", live or replays),
        ("swarm20.replay", replays),
        ("swarm20.calibrated", calibrated),
    ):
        for name in ("position_cm", "heading_deg", "nees", "located"):
            if ones:
                figures[f"{prefix}.{name}"] = float(np.mean([getattr(one, name) for one in ones]))
    return figures


def draw(result: ReplayResult) -> Path:
    """Errors of all robots over time."""
    errors = result.errors.values()
    since_s = [(one.stamp_ns - result.stamp_ns[0]) * 1e-9 for one in errors]
    figure, (course,) = new_plot(1, width=5.4)
    for at_s, one in zip(since_s, errors, strict=True):
        course.plot(at_s, 100.0 * one.position, color="C0", linewidth=0.8, alpha=0.6)
    course.set(xlabel="time [s]", ylabel="position error [cm]", yscale="log", title=result.title)
    return save_plot(figure, "droplet_swarm")
