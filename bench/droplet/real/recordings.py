"""Recordings of real Droplets as bags, and their clear pairs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.shared.common import ProgressLine
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.calibration.infrared.board import BoardReadings, BoardRecording, read_board
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.datasets.droplets import ImportSettings, import_recording
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm


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
