"""Laser calibration: the hyperbola is found again, distances say how sure they are, files are checked."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.files import FileError
from swarm_loc_estimator.common.messages.cdr import LASER, ODOMETRY, encode
from swarm_loc_estimator.common.messages.poses import UNKNOWN_COVARIANCE, encode_odometry
from swarm_loc_vision.laser.calibration import (
    CalibrationError,
    Drive,
    LaserCalibration,
    LaserFileError,
    RowBias,
    WallDrive,
    fit_hyperbola,
    fit_row_bias,
    load_laser,
    recorded_drive,
    save_laser,
)

BIAS = r"(?<=row_bias: ).*"
DEPTHS = np.linspace(0.1, 2.5, 200)


def drive(seed: int, *, sigma: float = 0.1, start_error: float = 0.003, outliers: float = 0.05) -> Drive:
    """A robot that drives from 2.55 m to 0.15 m from the wall."""
    rng = np.random.default_rng(seed)
    driven = np.linspace(0.0, 2.4, 1200)
    truth = LaserCalibration(63.0 + rng.random(), 6.0 + 0.5 * rng.random())
    rows = np.array([truth.row(2.55 + start_error - 0.04 - one) for one in driven])
    rows += sigma * rng.standard_normal(len(rows))
    is_outlier = rng.random(len(rows)) < outliers
    rows[is_outlier] = rng.uniform(64.0, 127.0, int(is_outlier.sum()))
    return Drive(2.55, 0.005, driven, rows, 0.04)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_the_hyperbola_is_found_to_a_centimetre(seed: int) -> None:
    one = drive(seed)
    rng = np.random.default_rng(seed)
    truth = LaserCalibration(63.0 + rng.random(), 6.0 + 0.5 * rng.random())
    found = fit_hyperbola(one)
    read = [found.focal_base / (truth.row(depth) - found.row_at_infinity) for depth in DEPTHS]
    assert 100.0 * np.sqrt(np.mean((read - DEPTHS) ** 2)) < 1.0
    assert found.row_sigma == pytest.approx(0.1, rel=0.2)


@given(depth=st.floats(0.12, 2.4), sigma=st.floats(0.1, 0.5))
def test_a_distance_and_its_sigma(depth: float, sigma: float) -> None:
    """Sigma is that of the row, carried on by the slope of the hyperbola: d^2 sigma_px / (f b)."""
    calibration = LaserCalibration()
    found = calibration.distance(calibration.row(depth), sigma**2)
    assert found.distance == pytest.approx(depth + 0.04)
    step = 1e-6
    slope = (calibration.row(depth + step) - calibration.row(depth - step)) / (2 * step)
    assert found.sigma == pytest.approx(sigma / abs(slope), rel=1e-6)


def test_a_bias_that_is_known_makes_distances_surer() -> None:
    known = replace(LaserCalibration(row_sigma=0.01), row_bias=RowBias(70.0, 0.5, (0.0, 0.0, 0.0)))
    within, beyond = (known.distance(row, 0.05**2, 0.04**2) for row in (70.5, 71.5))
    assert within.sigma == pytest.approx((within.distance - 0.04) ** 2 * 0.03 / 6.3)
    assert beyond.sigma == pytest.approx((beyond.distance - 0.04) ** 2 * 0.05 / 6.3)
    least = known.distance(70.5, 0.04**2, 0.04**2)
    assert least.sigma == pytest.approx((least.distance - 0.04) ** 2 * 0.01 / 6.3)


def test_beyond_the_calibration_there_is_no_distance() -> None:
    calibration = LaserCalibration()
    for row in (calibration.row(0.09), calibration.row(2.6), 60.0, math.nan):
        assert math.isnan(calibration.distance(row, 0.01).distance)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"driven": np.zeros(10), "rows": np.zeros(10)}, "seen 10 times"),
        ({"driven": np.linspace(0, 0.2, 100), "rows": np.full(100, 70.0)}, "too short"),
        ({"driven": np.linspace(0, 3.0, 100), "rows": np.full(100, 70.0)}, "start_distance is too small"),
        ({"rows": np.random.default_rng(1).uniform(64, 127, 1200)}, "no hyperbola"),
    ],
)
def test_drives_that_calibrate_nothing_say_why(changed: dict[str, Any], sentence: str) -> None:
    with pytest.raises(CalibrationError, match=sentence):
        fit_hyperbola(replace(drive(1), **changed))


def test_rows_are_taken_at_the_way_driven_at_their_stamps() -> None:
    collected = WallDrive(2.0, 0.2)
    collected.take_row(5, 99.0)
    for k in range(100):
        collected.take_odometry(1000 * k, 1.0, 2.0 + 0.02 * k, math.pi / 2)
        collected.take_row(1000 * k + 500, 64.0 + k)
    collected.take_row(200_000, math.nan)
    assert collected.is_done
    one = collected.drive(0.005, 0.04)
    np.testing.assert_allclose(one.driven[1:], 0.02 * (one.rows[1:] - 64.0 + 0.5), atol=1e-9)
    assert collected.count == 100


def test_a_robot_that_turns_is_stopped() -> None:
    collected = WallDrive(2.0, 0.2)
    collected.take_odometry(0, 0.0, 0.0, 3.1)
    collected.take_odometry(1, 0.1, 0.0, -3.12)
    with pytest.raises(CalibrationError, match="turned"):
        collected.take_odometry(2, 0.2, 0.0, -2.9)


def locked(row: float) -> float:
    """The bias of a tracker whose places are drawn towards the middles of pixels, more in some."""
    return 0.08 * math.sin(2.0 * math.pi * row) * (1.0 + 0.5 * math.sin(1.3 * row))


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_what_the_rows_are_off_within_pixels_is_found(seed: int) -> None:
    """Half of all readings beyond 80 cm lie closer to the truth than a fourth of the bias alone."""
    one = drive(seed, sigma=0.03)
    one = replace(one, rows=np.array([row + locked(row) for row in one.rows.tolist()]))
    bias = fit_hyperbola(one).row_bias
    rows = np.linspace(66.5, 70.0, 200)
    wrong = np.array([bias.at(row) - locked(row) for row in rows.tolist()])
    before = np.array([locked(row) for row in rows.tolist()])
    assert np.std(wrong) < 0.3 * np.std(before)


@pytest.mark.parametrize("seed", range(8))
def test_noise_alone_makes_hardly_a_bias(seed: int) -> None:
    bias = fit_hyperbola(drive(seed, sigma=0.05)).row_bias
    assert max(map(abs, bias.offsets), default=0.0) < 0.05


def test_outliers_make_no_bias() -> None:
    rng = np.random.default_rng(1)
    rows = rng.uniform(66.0, 70.0, 2000)
    residuals = 0.03 * rng.standard_normal(2000)
    residuals[::20] = 0.25
    assert max(map(abs, fit_row_bias(rows, residuals, 0.03).offsets), default=0.0) < 0.03


@given(row=st.floats(allow_nan=True, allow_infinity=True))
def test_beyond_its_knots_there_is_no_bias(row: float) -> None:
    bias = RowBias(66.0, 0.2, (0.1, 0.1, 0.3))
    found = bias.at(row)
    assert 0.1 <= found <= 0.3 if 66.0 <= row < 66.4 else found == 0.0


def test_a_file_holds_what_was_saved(tmp_path: Path) -> None:
    calibration = LaserCalibration(63.21, 6.123456, 0.087, 0.041, 0.12, 2.61)
    for one in (calibration, replace(calibration, row_bias=RowBias(65.5, 0.25, (0.05, -0.0625, 0.0)))):
        save_laser(tmp_path / "laser.yaml", one)
        assert load_laser(tmp_path / "laser.yaml") == one


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (r"(.|\n)*", "focal_base: 6.3\n", "the file lacks row_at_infinity"),
        (r"(.|\n)*", "unknown: 1\n", "'unknown' is not a known key; the nearest one is"),
        (r"(.|\n)*", "a list", "the file is 'a list' but must be a mapping"),
        (r"(.|\n)*", "focal_base: [", "laser.yaml"),
        ("focal_base: .*", "focal_base: -1", r"focal_base is -1 but must lie in \[0.01, 10000\] px m"),
        ("row_sigma: .*", "row_sigma: abc", "row_sigma is 'abc' but must be a number"),
        ("min_depth: .*", "min_depth: 9.0", "min_depth is 9.0 but must be below max_depth = 2.5"),
        (BIAS, "[1, 2]", r"row_bias is \[1, 2\] but must be a mapping"),
        (BIAS, "{first_row: 1, offsets: []}", "row_bias lacks step"),
        (BIAS, "{first_row: 1, step: 1, offsets: [], stop: 1}", "'row_bias.stop' is not a known key"),
        (BIAS, "{first_row: 1, step: 0, offsets: []}", r"row_bias.step is 0 but must lie in \(0, 10\] px"),
        (BIAS, "{first_row: 1, step: 1, offsets: 3}", "row_bias.offsets is 3 but must be a list"),
        (BIAS, "{first_row: 1, step: 1, offsets: [.nan]}", r"row_bias.offsets\[0\] is nan but must lie in"),
        (BIAS, "{first_row: 1, step: 1, offsets: [a]}", r"row_bias.offsets\[0\] is 'a' but must be a number"),
        (
            BIAS,
            f"{{first_row: 1, step: 1, offsets: {[0] * 10_001}}}",
            "has 10001 numbers but must have at most 10000",
        ),
    ],
)
def test_a_file_that_cannot_be_used_is_named(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    path = tmp_path / "laser.yaml"
    save_laser(path, LaserCalibration())
    bias = "row_bias: {first_row: 1, step: 1, offsets: []}\n"
    path.write_text(re.sub(old, new, path.read_text() + bias, count=1))
    with pytest.raises(LaserFileError, match=sentence):
        load_laser(path)


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(FileError, match=r"laser\.yaml cannot be written: File exists"):
        save_laser(tmp_path / "file" / "laser.yaml", LaserCalibration())


def write_drive(folder: Path, one: Drive, robot: str = "a") -> None:
    """A drive as a bag; messages that are cut in between."""
    stamps_ns = 1_000_000_000 + 20_000_000 * np.arange(len(one.driven))
    pose = np.column_stack([one.driven, np.zeros((len(one.driven), 2))])
    unknown = UNKNOWN_COVARIANCE
    odometry = encode_odometry("odom", "base_link", stamps_ns, pose, np.zeros_like(pose), unknown, unknown)
    with BagWriter(folder) as bag:
        bag.add_topic(f"{robot}/odom", ODOMETRY)
        bag.add_topic(f"{robot}/laser", LASER)
        for at_ns, data, row in zip(stamps_ns.tolist(), odometry, one.rows.tolist(), strict=True):
            nothing = {"distance": math.nan, "sigma": math.nan, "covariance": np.zeros(4), "events": 9}
            seen = encode({"header": {"stamp": at_ns}, "u_px": 64.0, "v_px": row, **nothing}, LASER)
            bag.write(f"{robot}/odom", at_ns, data)
            bag.write(f"{robot}/laser", at_ns, seen)
            if at_ns % 1_000_000_000 == 0:
                bag.write(f"{robot}/laser", at_ns, seen[:20])
                bag.write(f"{robot}/odom", at_ns, data[:20])


@pytest.mark.parametrize("seed", [1, 2])
def test_a_recorded_drive_calibrates_as_the_drive_itself(tmp_path: Path, seed: int) -> None:
    one = drive(seed)
    write_drive(tmp_path / "bag", one)
    again = recorded_drive(tmp_path / "bag", "a", WallDrive(2.55, 0.16)).drive(0.005, 0.04)
    assert len(again.rows) > 1100
    found, expected = fit_hyperbola(again), fit_hyperbola(one)
    assert found.row_at_infinity == pytest.approx(expected.row_at_infinity, abs=0.02)
    assert found.focal_base == pytest.approx(expected.focal_base, abs=0.02)


def test_a_bag_without_the_robots_drive_is_named(tmp_path: Path) -> None:
    write_drive(tmp_path / "bag", drive(1), "b")
    with pytest.raises(CalibrationError, match="has nothing usable on a/odom"):
        recorded_drive(tmp_path / "bag", "a", WallDrive(2.55, 0.16))
