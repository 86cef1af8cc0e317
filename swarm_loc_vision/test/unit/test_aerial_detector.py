"""The aerial detector on drawn pictures: all robots that are there are found, and nothing else."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.aerial.detector import Score, exact, score_picture, surveyed
from bench.aerial.pictures import DIAMETER, Look, Picture, draw_picture
from swarm_loc_vision.aerial.circles import DIRECTIONS, SIDES, TOP, Sides
from swarm_loc_vision.aerial.detector import AerialDetector
from swarm_loc_vision.aerial.ground_control import AerialSettings
from swarm_loc_vision.aerial.rectification import RectificationError

SETTINGS = AerialSettings(robot_diameter=DIAMETER)

LOOKS = {
    "plain": Look(),
    "small": Look(diameter_px=9.0),
    "tilted wide lens": Look(
        tilt=math.radians(25.0), field_of_view=math.radians(90.0), barrel=-0.1, diameter_px=20.0
    ),
    "uneven light and shadows": Look(gradient=0.2, shadow=0.6),
    "touching": Look(touching=0.8),
    "dark discs": Look(kind="dark"),
    "bright discs": Look(kind="bright", floor=0.3),
    "lights in the dark": Look(kind="led", floor=0.12, diameter_px=12.0),
    "pattern on a dark floor": Look(floor=0.12),
    "noise": Look(noise=10.0, texture=0.05),
    "tall with black sides": Look(height=0.05, shadow=0.3),
    "tall and touching": Look(height=0.03, touching=0.6),
    "tall and narrower below": Look(height=0.06, taper=0.35),
    "moving": Look(motion=0.2),
    "moving boards": Look(motion=0.15, kind="board", diameter_px=30.0),
    "at rails": Look(kind="board", diameter_px=28.0, robots=8, rails=0.7),
    "lids that touch": Look(kind="lid", diameter_px=32.0, robots=16, touching=1.0, shadow=0.4),
}


def scored(picture: Picture, settings: AerialSettings = SETTINGS, polarity: str = "auto") -> Score:
    """What a detector makes of a picture."""
    return score_picture(picture, AerialDetector(settings, picture.ground, polarity).detect(picture.gray))


@pytest.mark.parametrize("name", LOOKS)
def test_all_robots_are_found_and_nothing_else(name: str) -> None:
    picture = draw_picture(LOOKS[name], seed=11)
    score = scored(picture, replace(SETTINGS, robot_height=LOOKS[name].height))
    assert score.missed == 0
    assert score.false == 0
    assert score.position_m.max() < 0.1 * DIAMETER
    if picture.has_heading:
        assert len(score.heading) == len(picture.poses)
        assert np.abs(score.heading).max() < math.radians(8.0)
    else:
        assert len(score.heading) == 0


def test_outlines_of_tall_robots_are_hulls_of_top_and_base() -> None:
    rng = np.random.default_rng(4)
    sides = Sides(rng.normal(0.0, 5.0, 2), 0.08)
    centre, radius = rng.uniform(-150.0, 150.0, (40, 2)), rng.uniform(8.0, 16.0, 40)
    length, normal = sides.outline(centre, radius, np.full(40, SIDES))
    assert 1.3 < length.max() < 2.5
    rim = centre[:, None] + radius[:, None, None] * length[..., None] * DIRECTIONS
    depth = np.full(length.shape, -np.inf)
    for share in np.linspace(0.0, sides.share, 2001):
        slices = centre + share * (sides.foot - centre)
        away = np.linalg.norm(rim - slices[:, None], axis=-1)
        depth = np.maximum(depth, radius[:, None] * (1.0 - share) - away)
    assert np.abs(depth).max() < 0.01
    # the rim bends away from its tangents
    inwards = np.roll(rim, 1, axis=1) - rim
    assert np.einsum("cri,cri->cr", inwards, normal).max() < 0.01
    flat, straight = sides.outline(centre, radius, np.full(40, TOP))
    assert (flat == 1.0).all()
    assert (straight == DIRECTIONS).all()


@pytest.mark.parametrize("kind", ["dark", "bright"])
def test_the_size_is_found_out(kind: str) -> None:
    picture = draw_picture(Look(kind=kind, diameter_px=18.0), seed=3)
    detector = AerialDetector(AerialSettings(), picture.ground)
    score = score_picture(picture, detector.detect(picture.gray))
    assert (score.missed, score.false) == (0, 0)
    assert detector.diameter == pytest.approx(DIAMETER, rel=0.12)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["board", "dark"])
def test_robots_at_rails_are_found_without_their_size(kind: str, seed: int) -> None:
    picture = draw_picture(Look(kind=kind, diameter_px=30.0, robots=8, rails=1.0), seed)
    assert scored(picture, AerialSettings()).missed == 0


def test_a_size_by_which_nothing_was_found_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    picture = draw_picture(Look(kind="dark", diameter_px=18.0), seed=3)
    detector = AerialDetector(AerialSettings(), picture.ground)
    with monkeypatch.context() as patch:
        patch.setattr(detector, "_estimated", lambda _: 5.0 * DIAMETER)
        assert len(detector.detect(picture.gray)) == 0
    assert score_picture(picture, detector.detect(picture.gray)).missed == 0


def test_the_polarity_can_be_told() -> None:
    picture = draw_picture(Look(kind="dark"), seed=5)
    assert scored(picture, polarity="dark").missed == 0
    assert scored(picture, polarity="bright").missed == len(picture.poses)


def test_an_empty_floor_shows_no_robots() -> None:
    for seed in range(3):
        picture = draw_picture(Look(robots=0, shadow=0.5, texture=0.05), seed)
        assert scored(picture).false <= 1


def test_pure_noise_and_flat_images_show_no_robots() -> None:
    picture = draw_picture(Look(robots=1), seed=1)
    rng = np.random.default_rng(0)
    for gray in (
        rng.integers(0, 256, picture.gray.shape).astype(np.uint8),
        np.zeros_like(picture.gray),
        np.full_like(picture.gray, 255),
    ):
        assert len(AerialDetector(SETTINGS, picture.ground).detect(gray)) == 0


HONEST = {
    "plain": Look(),
    "15 px": Look(diameter_px=15.0),
    "48 px": Look(diameter_px=48.0, robots=6),
    "tilted": Look(tilt=math.radians(30.0)),
    "shadows": Look(shadow=0.4),
    "touching": Look(touching=0.8),
    "noise": Look(noise=10.0),
    "tall": Look(height=0.05),
    "tall, narrower below": Look(height=0.05, taper=0.3),
    "moving": Look(motion=0.2),
}


@pytest.mark.parametrize("name", HONEST)
def test_covariances_are_as_large_as_the_errors(name: str) -> None:
    look = HONEST[name]
    nees = np.concatenate([scored(draw_picture(look, seed), exact(look)).nees for seed in range(31, 34)])
    assert 0.7 < nees.mean() < 5.0  # of two numbers
    assert np.quantile(nees, 0.95) < 20.0


def test_covariances_contain_errors_of_control_points_and_height() -> None:
    look, nees = Look(height=0.05, tilt=0.3), []
    picture = draw_picture(look, seed=31)
    for survey in range(8):
        seen, settings = surveyed(picture, look, np.random.default_rng(survey))
        nees.append(float(scored(seen, settings).nees.mean()))
    assert 1.0 < np.mean(nees) < 4.0
    # the error is common: the mean over robots scatters nearly as that of one robot
    assert np.std(nees) > 0.5


def test_a_mark_beside_a_blurred_rim_moves_no_centre() -> None:
    ahead = []
    for seed in range(3):
        picture = draw_picture(Look(diameter_px=10.0), seed)
        found = AerialDetector(SETTINGS, picture.ground).detect(picture.gray)
        away = np.linalg.norm(found.place[:, None] - picture.poses[None, :, :2], axis=2).argmin(axis=0)
        error = found.place[away] - picture.poses[:, :2]
        front = np.stack([np.cos(picture.poses[:, 2]), np.sin(picture.poses[:, 2])], axis=1)
        ahead.append(np.einsum("ni,ni->n", error, front))
    assert abs(np.concatenate(ahead).mean()) < 0.005 * DIAMETER


def test_detections_are_bounded_and_the_clearest_are_kept() -> None:
    picture = draw_picture(Look(robots=20), seed=2)
    detections = AerialDetector(replace(SETTINGS, max_robots=7), picture.ground).detect(picture.gray)
    assert len(detections) == 7
    assert detections.dropped["too_many"] == 13
    assert scored(picture, replace(SETTINGS, max_robots=7)).false == 0


def test_outside_the_region_nothing_is_looked_for() -> None:
    picture = draw_picture(Look(robots=20), seed=2)
    detections = AerialDetector(replace(SETTINGS, x_min=0.0), picture.ground).detect(picture.gray)
    assert len(detections) > 0
    assert detections.place[:, 0].min() > 0.0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (replace(SETTINGS, min_diameter_px=500.0), "look smaller than 500 px everywhere"),
        (replace(SETTINGS, robot_height=9.0), "does not see the plane 9 m above the floor"),
        (replace(SETTINGS, x_min=500.0, x_max=501.0), "does not see the region"),
    ],
)
def test_what_cannot_be_seen_is_told(settings: AerialSettings, words: str) -> None:
    picture = draw_picture(Look(robots=1), seed=1)
    with pytest.raises(RectificationError, match=words):
        AerialDetector(settings, picture.ground).detect(picture.gray)
