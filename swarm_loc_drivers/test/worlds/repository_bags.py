"""What the simulated bags of the repository say that they were made by, and whether that gives them again."""

import re
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import typestore

BAGS = Path(__file__).parents[3] / "bags"
ROUNDING = 1e-9  # numpy's sines differ by their last bits where a processor has wider registers


def options_of(name: str) -> dict[str, str]:
    """The options in the first line of a bag's description, and its `swarm`."""
    first_line = (BAGS / name / "swarm.yaml").read_text(encoding="utf-8").splitlines()[0]
    said = dict(re.findall(r"(\w+)=([^,\s]+?)[,.]?(?=\s|$)", first_line))
    assert "True" not in said.values()
    return said


def words_of(name: str) -> list[str]:
    """These options as words of a command."""
    said = options_of(name)
    del said["swarm"]
    return [word for key, value in said.items() if value != "False" for word in (f"--{key}", value)]


def assert_same_messages(bag: Path, name: str) -> None:
    """A bag has the messages of that of the repository, numbers up to `ROUNDING`."""
    moved, stayed = Leaves(), Leaves()
    with BagReader(bag) as again, BagReader(BAGS / name) as kept:
        for one, other in zip(again.messages(), kept.messages(), strict=True):
            assert one[:3] == other[:3]
            if one != other:
                moved.add(typestore().deserialize_cdr(one[3], one[1]))
                stayed.add(typestore().deserialize_cdr(other[3], other[1]))
    assert moved.others == stayed.others
    numbers, others = (np.concatenate([[0.0], *leaves.numbers]) for leaves in (moved, stayed))
    np.testing.assert_allclose(numbers, others, rtol=0.0, atol=ROUNDING)


class Leaves:
    """The real numbers of messages, and their other values and texts."""

    def __init__(self) -> None:
        self.numbers: list[Any] = []
        self.others: list[Any] = []

    def add(self, part: Any) -> None:
        """Take a message, or a part of one."""
        if isinstance(part, str | int):
            self.others.append(part)
        elif isinstance(part, float):
            self.numbers.append([part])
        elif isinstance(part, np.ndarray) and part.dtype.kind == "f":
            self.numbers.append(part.ravel())
        elif isinstance(part, np.ndarray | list):
            for one in part:
                self.add(one)
        elif is_dataclass(part):
            for one in vars(part).values():
                self.add(one)
        else:
            self.others.append(part)
