"""The README says what the table of parameters says."""

from __future__ import annotations

from pathlib import Path

from swarm_loc_estimator.nodes.parameter_table import markdown_table
from swarm_loc_vision.nodes.detector_parameters import DetectorParameters

README = Path(__file__).parents[2] / "README.md"


def test_the_readme_says_what_the_table_says() -> None:
    assert markdown_table(DetectorParameters) in README.read_text(encoding="utf-8")
