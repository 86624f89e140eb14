"""Decoding one image: encodings of depth, and what is cut off or damaged."""

import contextlib
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorded_scene import scene

from nurbseg.common.depth import millimeters
from nurbseg.drivers import FrameFormatError
from nurbseg.drivers.datasets.images import decode_color, decode_labels, decode_stored

DEPTH_MM = scene(0).depth_mm
COLOR = scene(0).color


def encoded(extension: str, image: np.ndarray, *parameters: int) -> bytes:
    return cv2.imencode(extension, image, parameters)[1].tobytes()


COMPLETE = {
    "png": encoded(".png", DEPTH_MM),
    "pgm": encoded(".pgm", DEPTH_MM),
    "jpeg": encoded(".jpg", COLOR[..., ::-1]),
    "ppm": encoded(".ppm", COLOR[..., ::-1]),
}


@pytest.mark.parametrize(
    ("depth", "units_per_meter", "expected"),
    [
        # What is no number or does not fit is no depth, and so is the largest of 16 bits in any unit.
        (np.float32([0.0, 65.534, 65.535, 65.6, 70_000.0, -0.1, np.nan, np.inf]), 1.0, [0, 65534] + [0] * 6),
        *((np.uint16([0, 500, 65535]), per_meter, [0, 500_000 // per_meter, 0]) for per_meter in (250, 5000)),
    ],
)
def test_depth_that_does_not_fit_becomes_none(depth: np.ndarray, units_per_meter, expected) -> None:
    given = depth.copy()
    assert millimeters(depth, units_per_meter=units_per_meter).tolist() == expected
    np.testing.assert_array_equal(depth, given)


def test_color_is_red_green_blue_and_gray_is_spread() -> None:
    np.testing.assert_array_equal(decode_color(encoded(".png", COLOR[..., ::-1]), "a"), COLOR)
    gray = COLOR[..., 0]
    np.testing.assert_array_equal(decode_color(encoded(".png", gray), "a"), np.dstack([gray] * 3))
    alpha = np.dstack([COLOR[..., ::-1], gray])
    np.testing.assert_array_equal(decode_color(encoded(".png", alpha), "a"), COLOR)


def indexed_png(indices: np.ndarray, bits: int, kind: int) -> bytes:
    """Return a PNG of gray levels (kind 0) or of a palette of equal colors (3)."""

    def part(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = indices.shape
    digits = (indices[..., None] >> np.arange(bits - 1, -1, -1)) & 1
    packed = np.packbits(digits.reshape(height, -1).astype(np.uint8), axis=1)
    header = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    rows = b"".join(b"\0" + row.tobytes() for row in packed)
    palette = [(b"PLTE", bytes(3 * 2**bits)), (b"tRNS", b"\0")] if kind == 3 else []
    parts = [(b"IHDR", header), *palette, (b"IDAT", zlib.compress(rows))]
    return b"\x89PNG\r\n\x1a\n" + b"".join(part(*each) for each in parts) + part(b"IEND", b"")


@pytest.mark.parametrize("kind", [0, 3])
@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_labels_of_few_bits_are_their_indices(bits: int, kind: int) -> None:
    indices = np.arange(48 * 61).reshape(48, 61) % 2**bits
    np.testing.assert_array_equal(decode_labels(indexed_png(indices, bits, kind), "a"), indices)
    cut = indexed_png(indices, bits, kind)[:-20]
    with pytest.raises(FrameFormatError, match="a: the image is cut off"):
        decode_labels(cut, "a")


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(COMPLETE)), st.floats(0, 1))
def test_an_image_cut_off_anywhere_is_refused(kind: str, part: float) -> None:
    content = COMPLETE[kind]
    cut = content[: min(int(part * len(content)), len(content) - 1)]
    decode = decode_color if kind in ("jpeg", "ppm") else decode_stored
    with pytest.raises(FrameFormatError, match=r"^a: "):
        decode(cut, "a")


@settings(max_examples=150, deadline=None)
@given(st.integers(0, len(COMPLETE["png"]) - 1), st.integers(1, 255))
def test_no_changed_byte_of_a_png_changes_its_pixels_unnoticed(place: int, change: int) -> None:
    content = bytearray(COMPLETE["png"])
    content[place] ^= change
    # The last part is empty: its checksum is not checked.
    if place < len(content) - 12:
        with pytest.raises(FrameFormatError):
            decode_stored(bytes(content), "a")
    else:
        with contextlib.suppress(FrameFormatError):
            np.testing.assert_array_equal(decode_stored(bytes(content), "a"), DEPTH_MM)


def npy(array: np.ndarray, folder: Path) -> bytes:
    np.save(folder / "x.npy", array, allow_pickle=True)
    return (folder / "x.npy").read_bytes()


@pytest.mark.parametrize(
    ("array", "text"),
    [
        (np.zeros((4, 4), np.uint8), "expected depth of 16 bits"),
        (np.array([[{}]], object), "cannot be read .*Object arrays"),
        (np.zeros((2, 4, 4), np.uint16), r"expected one image .* \(2, 4, 4\)"),
    ],
)
def test_arrays_that_are_no_depth_image_are_refused(tmp_path: Path, array: np.ndarray, text: str) -> None:
    with pytest.raises(FrameFormatError, match=text):
        decode_stored(npy(array, tmp_path), "a")


def test_an_array_that_is_cut_off_or_declares_too_much_is_refused(tmp_path: Path) -> None:
    content = npy(np.ones((48, 64), np.uint16), tmp_path)
    for end in (4, 9, 60, len(content) - 1):
        with pytest.raises(FrameFormatError, match=r"^a: "):
            decode_stored(content[:end], "a")
    larger = content.replace(b"(48, 64), }" + b" " * 9, b"(480000, 6400000), }")
    assert larger != content
    with pytest.raises(FrameFormatError, match="the NumPy array cannot be read"):
        decode_stored(larger, "a")
    with pytest.raises(FrameFormatError, match="pixels at most"):
        decode_stored(npy(np.zeros((4097, 4096), np.uint16), tmp_path), "a")


def test_signed_16_bits_are_depth() -> None:
    depth = np.array([[-1, 0, 1500]], np.int16)
    content = cv2.imencode(".tiff", depth)[1].tobytes()
    np.testing.assert_array_equal(decode_stored(content, "a"), depth)


@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<i4", "<f2", "<f4", ">f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_that_numpy_saved_are_depth(tmp_path: Path, dtype: str, order: str) -> None:
    values = DEPTH_MM / 1000 if dtype[1] == "f" else DEPTH_MM
    # A channel of its own.
    stored = decode_stored(npy(np.asarray(values, dtype, order=order)[..., None], tmp_path), "a")
    found = millimeters(stored, units_per_meter=1.0 if dtype[1] == "f" else 1000.0)
    np.testing.assert_allclose(found.astype(int), DEPTH_MM, atol=1 if dtype == "<f2" else 0)
