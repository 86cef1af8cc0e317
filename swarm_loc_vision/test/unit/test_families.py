"""The words of the families, and their images."""

import cv2
import numpy as np
import pytest

from swarm_loc_estimator.swarm.new_swarm import FAMILY_IDS
from swarm_loc_vision.markers.families import draw_marker, families, family_named

BCH = family_named("artoolkit_bch_thin")
rotated = BCH.layout.rotated


def distances(word: np.uint64, words: np.ndarray[tuple[int], np.dtype[np.uint64]]) -> list[int]:
    return [int(other).bit_count() for other in words ^ word]


def test_bch_words_are_nine_bits_apart_in_one_orientation() -> None:
    # the code is linear but for a mask, so the distances to one word are those to any
    for marker_id in (0, 100, 4095):
        apart = distances(BCH.words[marker_id], BCH.words)
        assert sorted(apart)[:2] == [0, 9]


def test_bch_ids_come_close_when_turned() -> None:
    turned = np.concatenate([rotated(BCH.words, quarters) for quarters in (1, 2, 3)])
    closest = [min(distances(word, turned)) for word in BCH.words[3000:3100]]
    assert min(closest) == 2
    pair = np.concatenate([rotated(BCH.words[1550:1551], quarters) for quarters in (1, 2, 3)])
    assert min(distances(BCH.words[3080], pair)) <= 4  # who takes the first id that is near reads 1550


def test_bch_words_hold_their_id_above_the_mask() -> None:
    ids = ((BCH.words ^ np.uint64(0x8F80B8750)) >> np.uint64(24)).astype(int)
    assert (ids == np.arange(4096)).all()


def test_turning_four_quarters_changes_nothing() -> None:
    words = BCH.words[:50]
    assert (rotated(rotated(words, 1), 3) == words).all()
    assert (rotated(rotated(words, 2), 2) == words).all()
    assert (
        rotated(words, 1)
        == BCH.layout.packed(np.rot90(np.stack([BCH.pattern(i) for i in range(50)]), 1, (1, 2)))
    ).all()


def dictionary_of_opencv(name: str) -> cv2.aruco.Dictionary:
    """A dictionary of the installed OpenCV; skips the test where that is too old for it."""
    aruco = getattr(cv2, "aruco", None)
    if not hasattr(aruco, name) or not hasattr(aruco, "ArucoDetector"):
        pytest.skip(f"OpenCV {cv2.__version__} does not have {name}")
    return cv2.aruco.getPredefinedDictionary(getattr(aruco, name))


OPENCV = pytest.mark.parametrize(
    ("name", "of_opencv", "quarters"),
    [
        ("aruco_mip_36h12", "DICT_ARUCO_MIP_36h12", 0),
        ("apriltag_36h11", "DICT_APRILTAG_36h11", 2),  # OpenCV turns these by half a turn
        ("apriltag_16h5", "DICT_APRILTAG_16h5", 2),
        ("apriltag_25h9", "DICT_APRILTAG_25h9", 2),
        *(
            (f"aruco_{n}x{n}_{count}", f"DICT_{n}X{n}_{count}", 0)
            for n in (4, 5, 6, 7)
            for count in (50, 100, 250, 1000)
        ),
    ],
)


@OPENCV
def test_words_are_those_of_opencv(name: str, of_opencv: str, quarters: int) -> None:
    dictionary, family = dictionary_of_opencv(of_opencv), family_named(name)
    assert len(family.words) == len(dictionary.bytesList)
    for marker_id in range(len(family.words)):
        drawn = np.rot90(dictionary.generateImageMarker(marker_id, family.side), quarters)
        assert (drawn == 255 * family.pattern(marker_id)).all()


@OPENCV
def test_opencv_reads_what_is_drawn(name: str, of_opencv: str, quarters: int) -> None:
    dictionary = dictionary_of_opencv(of_opencv)
    detector = cv2.aruco.ArucoDetector(dictionary)
    for marker_id in (0, 7, len(dictionary.bytesList) - 1):
        corners, ids, _ = detector.detectMarkers(draw_marker(family_named(name), marker_id, 8, 2))
        assert np.ravel(ids).tolist() == [marker_id]
        assert np.ravel(corners[0])[2 * quarters : 2 * quarters + 2] == pytest.approx([16, 16], abs=1)


@pytest.mark.parametrize(
    ("name", "count", "apart"),
    [
        ("aruco_mip_36h12", 250, 12),
        ("apriltag_36h11", 587, 11),
        ("apriltag_16h5", 30, 5),
        ("apriltag_25h9", 35, 9),
        ("apriltag_standard_41h12", 2115, 12),
    ],
)
def test_published_words_are_apart_in_all_orientations(name: str, count: int, apart: int) -> None:
    family = family_named(name)
    assert len(family.words) == count
    turned = np.concatenate([family.layout.rotated(family.words, quarters) for quarters in range(4)])
    some = family.words[:: max(1, count // 600)]
    assert min(sorted(distances(word, turned))[1] for word in some) == apart


TAGS = [
    (name, name.replace("apriltag_standard_", "tagStandard").replace("apriltag_", "tag"))
    for name in ("apriltag_16h5", "apriltag_25h9", "apriltag_36h11", "apriltag_standard_41h12")
]


@pytest.mark.parametrize(("name", "of_apriltag"), TAGS)
def test_the_library_of_apriltag_reads_what_is_drawn(name: str, of_apriltag: str) -> None:
    library = pytest.importorskip("pupil_apriltags")
    library.Detector.__del__ = lambda _: None  # it frees its families twice: the process would end in a crash
    detector, family = (
        library.Detector(families=of_apriltag, nthreads=1, quad_decimate=1.0),
        family_named(name),
    )
    for marker_id in (0, 7, len(family.words) - 1):
        (found,) = detector.detect(draw_marker(family, marker_id, 10, 2))
        assert found.tag_id == marker_id
        first, size = 10 * (2 + family.layout.outside), 10 * family.side
        upper_left = found.corners[3] - first
        assert upper_left == pytest.approx([0.0, 0.0], abs=1.0)
        assert found.corners[1] - first == pytest.approx([size, size], abs=1.0)


def test_a_surrounded_marker_is_a_white_border_in_a_black_ring_between_data() -> None:
    pattern = family_named("apriltag_standard_41h12").pattern(3)
    assert pattern.shape == (9, 9)
    assert not pattern[1:-1, [1, -2]].any()
    assert not pattern[[1, -2], 1:-1].any()
    assert pattern[2:-2, [2, -3]].all()
    assert pattern[[2, -3], 2:-2].all()
    outer = np.concatenate([pattern[0], pattern[-1], pattern[1:-1, 0], pattern[1:-1, -1]])
    assert 0 < outer.sum() < outer.size


def test_sizes_of_images_and_borders() -> None:
    thin, thick = family_named("artoolkit_bch_thin"), family_named("artoolkit_bch_thick")
    assert draw_marker(thin, 0, 5, 1).shape == (50, 50)
    assert draw_marker(thick, 0, 5, 0).shape == (60, 60)
    image = draw_marker(thick, 3, 1, 1)
    assert (image[0] == 255).all()
    assert (image[1:4, 1:-1] == 0).all()
    assert thin.side - 6 == 0.125 * 2 * thin.side
    assert thick.side - 6 == 0.25 * 2 * thick.side


def test_unknown_names_and_ids_are_one_sentence() -> None:
    with pytest.raises(ValueError, match="there is no marker family 'qr', only artoolkit_bch_thin"):
        family_named("qr")
    with pytest.raises(ValueError, match="aruco_mip_36h12 has ids 0 to 249, not 250"):
        families()["aruco_mip_36h12"].pattern(250)


def test_new_descriptions_know_the_families_and_their_ids() -> None:
    assert {name: len(family.words) for name, family in families().items()} == FAMILY_IDS
