"""Infrared platforms: curves, numbers, files."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ir_world import ANGLES, droplet, emitter_20, far_21, sensor_19

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import amplitude_at, curve_at, distance_at
from swarm_loc_estimator.swarm.ir_board import (
    PACKAGED,
    Amplitude,
    IrGains,
    IrPlatformError,
    IrPlatformFileError,
    PairGains,
    PowerCurve,
    PowerPiece,
    TabulatedCurve,
    load_ir_platform,
)

DROPLET_FILE = Path(__file__).parents[2] / "swarm_loc_estimator" / "config" / "ir" / "droplet.yaml"


def values(curve: PowerCurve | TabulatedCurve, angles: FloatArray) -> FloatArray:
    table = curve.table()
    return np.array([curve_at(table, float(angle)) for angle in angles])


def test_the_droplets_curves_are_those_of_the_paper() -> None:
    platform = droplet()
    angles = np.linspace(-np.pi, np.pi, 4001, endpoint=False)
    np.testing.assert_allclose(values(platform.sensor, angles)[:, 0], sensor_19(angles), atol=2e-6)
    np.testing.assert_allclose(values(platform.emitter, angles)[:, 0], emitter_20(angles), atol=2e-6)
    for r in np.linspace(0.035, 0.3, 50):
        assert amplitude_at(platform.model.amplitudes[0], r)[0] == pytest.approx(float(far_21(r)), rel=1e-12)
    np.testing.assert_allclose(platform.angles, ANGLES, atol=1e-8)


def test_slopes_are_those_of_the_values_and_one_sided_at_the_kink() -> None:
    platform = droplet()
    for curve, kink in ((platform.sensor, 0.6186), (platform.emitter, 0.7205)):
        angles = np.linspace(-3.1, 3.1, 399)
        step = 1e-6
        numeric = (values(curve, angles + step)[:, 0] - values(curve, angles - step)[:, 0]) / (2.0 * step)
        np.testing.assert_allclose(values(curve, angles)[:, 1], numeric, atol=1e-4)
        inside, outside = values(curve, np.array([kink - 1e-9, kink + 1e-9]))[:, 1]
        assert outside / inside > 2.0  # the errata: the slope jumps


def test_angles_are_wrapped_before_a_curve_is_asked() -> None:
    """Eqs (19) and (20) with angles as they come out of (11)-(14) are far too dark beyond pi."""
    angles = np.array([-5.9, 6.2, 7.0, 2.0 * np.pi + 0.3])
    curve = values(droplet().sensor, angles)[:, 0]
    np.testing.assert_allclose(curve, sensor_19(np.mod(angles + np.pi, 2 * np.pi) - np.pi), atol=2e-6)
    assert np.all(sensor_19(angles) < 0.01 * curve)


def test_brightness_falls_with_distance_down_to_contact_despite_the_printed_pole() -> None:
    """Eq. (21) is claimed to be monotonic on (0, inf) and has a pole at 3 cm."""
    distances = np.linspace(1e-4, 0.5, 5000)
    for law in droplet().model.amplitudes:
        bright, slope = np.array([amplitude_at(law, r) for r in distances]).T
        assert np.all(np.diff(bright) < 0.0)
        assert np.all(np.isfinite(bright))
        numeric = np.gradient(bright, distances)
        np.testing.assert_allclose(slope[1:-1], numeric[1:-1], rtol=0.2)
    assert far_21(np.array(0.01)) < far_21(np.array(0.029))


@pytest.mark.parametrize("mode", [0, 1])
def test_the_inverse_amplitude_gives_the_distance_back(mode: int) -> None:
    platform = droplet()
    distances = np.linspace(0.001, 0.6, 200)
    law = platform.model.amplitudes[mode]
    bright = np.array([amplitude_at(law, r)[0] for r in distances])
    back = [distance_at(law, one) for one in bright]
    np.testing.assert_allclose(back, distances, atol=1e-12)
    assert distance_at(law, -1.0) == np.inf


def test_a_table_passes_its_points_and_stays_between_them() -> None:
    angles, heights = (-1.0, -0.5, 0.0, 0.5, 1.2), (0.1, 0.6, 1.0, 0.7, 0.1)
    curve = TabulatedCurve(angles, heights)
    np.testing.assert_allclose(values(curve, np.array(angles))[:, 0], heights, atol=2e-3)
    np.testing.assert_allclose(values(curve, np.array([-3.0, 3.0]))[:, 0], [0.1, 0.1], atol=1e-12)
    everywhere = values(curve, np.linspace(-3.1, 3.1, 999))[:, 0]
    assert everywhere.min() >= 0.1 - 1e-9
    assert everywhere.max() <= 1.0 + 1e-9


@pytest.mark.parametrize(
    ("pieces", "words"),
    [
        ((), "must ascend from 0 to pi"),
        ((PowerPiece(1.0, ((1.0, 0.0),)),), "must ascend from 0 to pi"),
        ((PowerPiece(1.0, ((1.0, 0.0),)), PowerPiece(math.pi, ((0.5, 0.0),))), "do not meet at 1 rad"),
        ((PowerPiece(math.pi, ((1.0, -2.0),)),), "not finite"),
        ((PowerPiece(math.pi, ((1.0, 0.0), (-1.0, 2.0))),), "must not be negative"),
        ((PowerPiece(math.pi, ((0.0, 0.0),)),), "zero everywhere"),
    ],
)
def test_curves_that_cannot_be_are_refused(pieces: tuple[PowerPiece, ...], words: str) -> None:
    with pytest.raises(IrPlatformError, match=words):
        PowerCurve(pieces)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"angles": (0.0, 1.0)}, "angles has 2 elements but must have 3 to 32"),
        ({"angles": (0.0, 1.0, 2.0 * math.pi)}, "no two elements may coincide"),
        ({"angles": (0.0, 1.0, math.nan)}, "must lie within"),
        ({"radius": 0.0}, r"radius is 0 but must lie in \(0, 10\] m"),
        ({"noise": math.nan}, "noise is nan"),
        ({"dark_level": 255.0}, "dark_level is 255 count but must be below saturation, 255"),
        ({"amplitudes": ()}, "must have one or two"),
    ],
)
def test_platforms_that_cannot_be_are_refused(changes: dict[str, object], words: str) -> None:
    with pytest.raises(IrPlatformError, match=words):
        replace(droplet(), **changes)  # type: ignore[arg-type]


def test_a_pole_must_be_nearer_than_the_law_reaches() -> None:
    with pytest.raises(IrPlatformError, match=r"nearest is 0.03 m but must be beyond the pole at 0.03 m"):
        Amplitude(offset=-0.03, nearest=0.03)


def test_gains_of_pairs_take_the_receivers_sensors_and_the_transmitters_emitters() -> None:
    one = IrGains((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), 0.1, 0.2)
    two = IrGains((7.0, 8.0, 9.0), (1.5, 1.6, 1.7), 0.3, 0.4)
    pairs = PairGains.of([one, two], [two, one])
    np.testing.assert_array_equal(pairs.sensor, [one.sensor, two.sensor])
    np.testing.assert_array_equal(pairs.emitter, [two.emitter, one.emitter])
    np.testing.assert_array_equal(pairs.sigma, [[0.1, 0.2, 0.3, 0.4], [0.3, 0.4, 0.1, 0.2]])


@pytest.mark.parametrize(
    ("sensor", "emitter", "words"),
    [((1.0,) * 3, (1.0,) * 4, "as many of both"), ((1.0, 1.0, 0.0), (1.0,) * 3, r"gains.sensor has 0 but")],
)
def test_gains_that_cannot_be_are_refused(
    sensor: tuple[float, ...], emitter: tuple[float, ...], words: str
) -> None:
    with pytest.raises(IrPlatformError, match=words):
        IrGains(sensor, emitter)


@pytest.mark.parametrize("name", PACKAGED)
def test_every_packaged_platform_loads(name: str) -> None:
    platform = load_ir_platform(name)
    assert platform.n == {"droplet": 6, "droplet_2016": 6, "epuck_twelve": 12}[name]
    assert platform.powers == (("far", "near") if name == "droplet" else ("far",))


def test_a_file_may_be_named_by_a_path_from_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.yaml").write_text(DROPLET_FILE.read_text())
    monkeypatch.chdir(tmp_path)
    assert load_ir_platform("mine.yaml") == load_ir_platform("droplet")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("fileversion: 1", "fileversion: 2", "fileversion is 2 but must be 1."),
        ("radius: 0.022", "radius: -1", "radius is -1 but must lie in (0, 10] m."),
        ("radius: 0.022", "radios: 1", "'radios' is not a known key; the nearest one is 'radius'."),
        ("saturation: 255.0", "saturation: many", "saturation is 'many' but must be a number in"),
        ("angles: [", "angles: [] # ", "angles has 0 elements"),
        ("angles: [-0.523598776,", "angles: [1.570796327,", "no two elements may coincide."),
        ("below: 0.6186", "below: 0.5", "sensor.pieces do not meet at 0.5 rad"),
        (
            "[-1.0, 4]]}\n    - {terms: [[0.25",
            "[-1.0]]}\n    - {terms: [[0.25",
            "emitter.pieces[0].terms[2] is",
        ),
        ("  far:", "  fare:", "'powers.fare' is not a known key; the nearest one is 'far'."),
        ("nearest: 0.035", "nearest: 0.01", "powers.far.nearest is 0.01 m but must be beyond the pole"),
        ("{scale: 0.1, offset: 0.006,", "{", "powers.near lacks scale, a number in (0, 1e+09]"),
        ("sensor:\n  pieces:", "sensor:\n  peaces:", "'sensor.peaces' is not a known key"),
    ],
)
def test_a_wrong_file_says_which_key(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = DROPLET_FILE.read_text()
    assert old in text
    (tmp_path / "wrong.yaml").write_text(text.replace(old, new, 1))
    with pytest.raises(IrPlatformFileError) as raised:
        load_ir_platform(str(tmp_path / "wrong.yaml"))
    assert words in str(raised.value)
    assert str(raised.value).startswith(str(tmp_path / "wrong.yaml"))


def test_an_unknown_name_lists_those_that_there_are() -> None:
    with pytest.raises(
        IrPlatformFileError, match=r"'dropled' is no packaged .* \(droplet, droplet_2016, epuck_twelve\)"
    ):
        load_ir_platform("dropled")
