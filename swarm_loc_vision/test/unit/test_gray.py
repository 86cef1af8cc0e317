"""Encodings of images."""

import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from swarm_loc_vision.common.images import Gray, ImageError, Pixels, decoded_image, gray_image

WIDTH, HEIGHT = 14, 10
SHADES = np.linspace(10, 240, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).astype(np.uint8)
COLOURS = np.stack([SHADES, SHADES[::-1], 255 - SHADES], axis=2)  # red, green, blue
RGB_GRAY = cv2.cvtColor(COLOURS, cv2.COLOR_RGB2GRAY)


def gray(
    encoding: str, width: int, height: int, step: int, data: bytes, *, is_bigendian: bool = False
) -> Gray:
    fields = {"encoding": encoding, "width": width, "height": height, "step": step, "data": data}
    return gray_image(SimpleNamespace(**fields, is_bigendian=is_bigendian), (width, height))


def decoded(how: str, data: object) -> Gray:
    return decoded_image(SimpleNamespace(format=how, data=data), (WIDTH, HEIGHT))


def wide(order: str, pixels: NDArray[np.uint8] = SHADES) -> NDArray[np.uint8]:
    return (np.ascontiguousarray(pixels).astype(order + "u2") * 257).view(np.uint8).reshape(HEIGHT, -1)


@pytest.mark.parametrize(
    ("encoding", "data", "expected"),
    [
        ("mono8", SHADES, SHADES),
        ("mono16", wide("<"), SHADES),
        ("rgb8", COLOURS, RGB_GRAY),
        ("bgr8", COLOURS[..., ::-1], RGB_GRAY),
        ("rgba8", np.dstack([COLOURS, SHADES]), RGB_GRAY),
        ("bgra8", np.dstack([COLOURS[..., ::-1], SHADES]), RGB_GRAY),
        ("8UC1", SHADES, SHADES),
        ("16UC1", wide("<"), SHADES),
        ("8UC3", COLOURS[..., ::-1], RGB_GRAY),
        ("8UC4", np.dstack([COLOURS[..., ::-1], SHADES]), RGB_GRAY),
        ("yuyv", np.dstack([SHADES, SHADES[::-1]]), SHADES),
        ("uyvy", np.dstack([SHADES[::-1], SHADES]), SHADES),
    ],
)
def test_encodings(encoding: str, data: NDArray[np.uint8], expected: NDArray[np.uint8]) -> None:
    rows = np.ascontiguousarray(data).reshape(HEIGHT, -1)
    padded = np.pad(rows, ((0, 0), (0, 5)))  # cameras may leave bytes at the end of rows
    for image in (rows, padded):
        shown = gray(encoding, WIDTH, HEIGHT, image.shape[1], image.tobytes())
        assert (shown == expected).all()
        assert shown.flags.writeable
        assert shown.flags.c_contiguous


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected", "tolerance"),
    [
        ("mono", SHADES, SHADES, 0),
        ("rgb", COLOURS, RGB_GRAY, 1),
        ("bgr", COLOURS[..., ::-1], RGB_GRAY, 1),
        ("rgba", np.dstack([COLOURS, SHADES]), RGB_GRAY, 1),
        ("bgra", np.dstack([COLOURS[..., ::-1], SHADES]), RGB_GRAY, 1),
    ],
)
@pytest.mark.parametrize("order", ["<", ">"])
def test_16_bits_in_both_orders(
    encoding: str, pixels: NDArray[np.uint8], expected: NDArray[np.uint8], tolerance: int, order: str
) -> None:
    rows = wide(order, pixels)
    shown = gray(f"{encoding}16", WIDTH, HEIGHT, rows.shape[1], rows.tobytes(), is_bigendian=order == ">")
    assert np.abs(shown.astype(int) - expected).max() <= tolerance


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_bayer_of_16_bits_is_that_of_8(pattern: str, order: str) -> None:
    expected = gray(f"bayer_{pattern}8", WIDTH, HEIGHT, WIDTH, SHADES.tobytes())
    raw = wide(order).tobytes()
    shown = gray(f"bayer_{pattern}16", WIDTH, HEIGHT, 2 * WIDTH, raw, is_bigendian=order == ">")
    assert np.abs(shown.astype(int) - expected).max() <= 1


@pytest.mark.parametrize(
    ("encoding", "colour_rows"), [("nv12", HEIGHT // 2), ("NV12", HEIGHT // 2), ("nv21", 5), ("nv24", 20)]
)
@pytest.mark.parametrize("padding", [0, 5])
def test_planar_yuv_shows_its_first_plane(encoding: str, colour_rows: int, padding: int) -> None:
    step = WIDTH + padding
    planes = np.zeros((HEIGHT + colour_rows, step), np.uint8)
    planes[:HEIGHT, :WIDTH] = SHADES
    assert (gray(encoding, WIDTH, HEIGHT, step, planes.tobytes()) == SHADES).all()
    with pytest.raises(ImageError, match=f"but 14 x 10 pixels in '{encoding}' must have at least"):
        gray(encoding, WIDTH, HEIGHT, step, planes[:-1].tobytes())


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_16_bit_images_show_the_highest_bits_that_any_pixel_uses(bits: int) -> None:
    pixels = (SHADES.astype(np.uint32) << bits >> 8).astype("<u2")
    assert (gray("mono16", WIDTH, HEIGHT, 2 * WIDTH, pixels.tobytes()) == SHADES).all()
    assert (decoded("mono16; png compressed", file_of(pixels, ".png")) == SHADES).all()


def test_bayer_of_a_gray_scene_is_gray() -> None:
    flat = np.full((HEIGHT, WIDTH), 99, np.uint8)
    for encoding in ("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"):
        assert (gray(encoding, WIDTH, HEIGHT, WIDTH, flat.tobytes()) == 99).all()


@pytest.mark.parametrize(
    ("encoding", "width", "step", "size", "reason"),
    [
        ("jpeg", WIDTH, WIDTH, WIDTH * HEIGHT, "encoding"),
        ("", WIDTH, WIDTH, WIDTH * HEIGHT, "encoding"),
        ("mono8", WIDTH, WIDTH, WIDTH * HEIGHT - 1, "size"),
        ("mono8", WIDTH, WIDTH - 1, WIDTH * HEIGHT, "size"),
        ("rgb8", WIDTH, WIDTH, WIDTH * HEIGHT, "size"),
        ("mono8", 0, 0, 0, "size"),
    ],
)
def test_what_is_no_image_is_refused(encoding: str, width: int, step: int, size: int, reason: str) -> None:
    with pytest.raises(ImageError) as caught:
        gray(encoding, width, HEIGHT, step, bytes(size))
    assert caught.value.reason == reason


def file_of(pixels: Pixels, suffix: str) -> bytes:
    return cv2.imencode(suffix, pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


@pytest.mark.parametrize(
    ("how", "suffix", "pixels", "expected", "tolerance"),
    [
        ("jpeg", ".jpg", SHADES, SHADES, 4),
        ("mono8; jpeg compressed mono8", ".jpg", SHADES, SHADES, 4),
        ("bgr8; jpeg compressed bgr8", ".jpg", COLOURS[..., ::-1], RGB_GRAY, 12),
        ("JPG", ".jpg", SHADES, SHADES, 4),
        ("png", ".png", SHADES, SHADES, 0),
        ("rgb8; png compressed bgr8", ".png", COLOURS[..., ::-1], RGB_GRAY, 1),
        ("", ".jpg", SHADES, SHADES, 4),
        (" ", ".png", SHADES, SHADES, 0),
        ("mono16; png compressed mono16", ".png", SHADES.astype(np.uint16) * 257, SHADES, 0),
    ],
)
def test_compressed_images(
    how: str, suffix: str, pixels: NDArray[np.uint8], expected: NDArray[np.uint8], tolerance: int
) -> None:
    data = file_of(np.ascontiguousarray(pixels), suffix)
    for padded in (data, data + bytes(7)):  # cameras may send more bytes than the image has
        shown = decoded(how, np.frombuffer(padded, np.uint8))
        assert shown.shape == SHADES.shape
        assert np.abs(shown.astype(int) - expected).max() <= tolerance
        assert shown.flags.writeable
        assert shown.flags.c_contiguous


def test_an_image_is_not_turned_by_what_its_exif_says() -> None:
    turned = bytes.fromhex("45786966000049492a00080000000100120103000100000006000000000000000000")
    data = file_of(SHADES, ".jpg")
    data = data[:2] + b"\xff\xe1" + (len(turned) + 2).to_bytes(2, "big") + turned + data[2:]
    assert decoded("jpeg", data).shape == SHADES.shape


def resized(data: bytes, width: int, height: int) -> bytes:
    """A PNG or JPEG that says it has another size."""
    if data.startswith(b"\x89PNG"):
        head = b"IHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big") + data[24:29]
        return data[:12] + head + zlib.crc32(head).to_bytes(4, "big") + data[33:]
    place = data.index(b"\xff\xc0")
    return data[: place + 5] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + data[place + 9 :]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("size", [(60000, 60000), (WIDTH + 1, HEIGHT), (WIDTH, HEIGHT - 1), (0, 0)])
def test_an_image_of_another_size_is_not_decoded(
    suffix: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", pytest.fail)
    with pytest.raises(ImageError) as caught:
        decoded(suffix, resized(file_of(SHADES, suffix), *size))
    assert caught.value.reason == "size"


@pytest.mark.parametrize("segment", [b"\xff\xfe\x00\x02", b"\xff"])
def test_a_header_without_end_is_not_searched_for_ever(
    segment: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = file_of(SHADES, ".jpg")
    assert (decoded("jpeg", data[:2] + 3 * segment + data[2:]) == decoded("jpeg", data)).all()
    monkeypatch.setattr(cv2, "imdecode", pytest.fail)
    with pytest.raises(ImageError) as caught:
        decoded("jpeg", data[:2] + 5_000_000 * segment + data[2:])
    assert caught.value.reason == "corrupt"


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_compressed_image_cut_off_anywhere_is_refused(suffix: str) -> None:
    data = file_of(SHADES, suffix)
    end = data.rfind(b"IEND") if suffix == ".png" else len(data) - 1
    for length in range(0, end, 3):
        with pytest.raises(ImageError) as caught:
            decoded(suffix, data[:length])
        assert caught.value.reason == "corrupt"


@pytest.mark.parametrize(
    ("how", "data", "reason"),
    [
        ("", file_of(SHADES, ".bmp"), "encoding"),
        ("", b"", "encoding"),
        ("", file_of(SHADES, ".jpg")[:-2], "corrupt"),
        ("tiff", file_of(SHADES, ".jpg"), "encoding"),
        ("16UC1; compressedDepth png", bytes(12) + file_of(SHADES, ".png"), "encoding"),
        ("png", file_of(SHADES, ".jpg"), "corrupt"),
        ("jpeg", file_of(SHADES, ".png"), "corrupt"),
        ("jpeg", b"\xff\xd8\xff\xda\xff\xd9", "corrupt"),
        ("jpeg", np.random.default_rng(0).bytes(999), "corrupt"),
    ],
)
def test_what_is_no_compressed_image_is_refused(how: str, data: bytes, reason: str) -> None:
    with pytest.raises(ImageError) as caught:
        decoded(how, data)
    assert caught.value.reason == reason
