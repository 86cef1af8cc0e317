"""The pages of the event tracker and of the laser's calibration have the parameters as they are."""

from pathlib import Path

import pytest

from bench.shared.parameter_table import markdown_table
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_vision.events.tracker import EventTrackerParameters, laser_calibration, light_sources
from swarm_loc_vision.laser.calibration import LaserCalibration, save_laser

DOC = Path(__file__).parents[2] / "doc"


def test_the_trackers_page_has_its_parameters() -> None:
    assert markdown_table(EventTrackerParameters) in (DOC / "event_tracker_node.md").read_text(
        encoding="utf-8"
    )


def test_the_laser_comes_first_and_lights_by_frequency() -> None:
    sources = light_sources(EventTrackerParameters(light_frequencies=("1000", "700", "700")))
    assert [(one.frequency, one.is_above) for one in sources] == [
        (450.0, False),
        (700.0, True),
        (1000.0, True),
    ]


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"laser_frequency": 0.0}, "leave nothing to track"),
        ({"laser_frequency": 3.0}, "laser_frequency = 3.0 must lie in"),
        ({"light_frequencies": ("nan",)}, "light_frequencies = 'nan' must lie in"),
        (
            {"light_frequencies": tuple(str(one) for one in range(100, 140))},
            "has 40 entries, the most are 31",
        ),
    ],
)
def test_frequencies_that_cannot_be_are_named(changed: dict[str, object], sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        light_sources(EventTrackerParameters(**changed))  # type: ignore[arg-type]


def test_the_calibration_is_the_one_named(tmp_path: Path) -> None:
    save_laser(tmp_path / "laser.yaml", LaserCalibration())
    parameters = EventTrackerParameters(calibration=str(tmp_path / "laser.yaml"))
    assert laser_calibration(parameters) == LaserCalibration()
    assert laser_calibration(EventTrackerParameters()) is None
