"""Images as other libraries write them: their turns, pages, colors and packed numbers."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from recorded_scene import scene, scenes, write_image

from nurbseg.drivers import RecordingFormatError, SourceOptions, open_source

FRAME = scene(0)
GIVEN = SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))


def pair(
    folder: Path,
    depth: Callable[[Path], object] | None = None,
    color: Callable[[Path], object] | None = None,
    extension: str = "tiff",
):
    """Write a pair, one of whose images is written by another library, and read it."""
    folder = folder / ("depth" if depth else "color")
    depth_path = folder / f"a_depth.{extension if depth else 'png'}"
    color_path = folder / f"a_color.{extension if color else 'png'}"
    folder.mkdir(exist_ok=True)
    write_image(depth_path, FRAME.depth_mm) if depth is None else depth(depth_path)
    write_image(color_path, FRAME.color) if color is None else color(color_path)
    with open_source(folder, GIVEN) as source:
        (frame,) = source
    return frame


def test_a_tiff_of_several_images_is_refused(tmp_path: Path) -> None:
    def write(path: Path) -> None:
        tifffile.imwrite(path, np.stack([FRAME.depth_mm, scene(1).depth_mm]))

    with pytest.raises(RecordingFormatError, match=r"a_depth\.tiff: the TIFF has several images"):
        pair(tmp_path, write)


def floating(path: Path) -> None:
    np.save(path, FRAME.color / 255)


def planes(path: Path) -> None:
    np.save(path, FRAME.color.transpose(2, 0, 1))


@pytest.mark.parametrize(
    ("color", "extension", "said"),
    [
        (floating, "npy", r"a_color\.npy: expected color of 8 bits, RGB, got an array of float64"),
        (planes, "npy", r"a_color\.npy: expected one image .*\(H, W, 3\), got an array of '?\(3, 48, 64\)"),
    ],
)
def test_color_in_other_numbers_is_refused_by_name(tmp_path: Path, color, extension: str, said: str) -> None:
    with pytest.raises(RecordingFormatError, match=said):
        pair(tmp_path, None, color, extension)


def test_color_may_be_an_array_of_numpy(tmp_path: Path) -> None:
    for frame in scenes(2):
        for kind, image in (("color", frame.color), ("depth", frame.depth_mm)):
            (tmp_path / kind).mkdir(exist_ok=True)
            np.save(tmp_path / kind / f"{frame.index}.npy", image)
    with open_source(tmp_path, GIVEN) as source:
        for frame, expected in zip(source, scenes(2), strict=True):
            np.testing.assert_array_equal(frame.color, expected.color)
            np.testing.assert_array_equal(frame.depth_mm, expected.depth_mm)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
def test_color_in_a_tiff_of_other_numbers_is_said_to_need_8_bits(tmp_path: Path, dtype) -> None:
    def write(path: Path) -> None:
        tifffile.imwrite(path, FRAME.color.astype(dtype), photometric="rgb")

    with pytest.raises(RecordingFormatError, match=r"a_color\.tiff: .* not read; save color as 8 bits"):
        pair(tmp_path, None, write)


def png_of(bits: int, values: np.ndarray) -> bytes:
    """Return a PNG of gray levels of a few bits."""
    packed = np.packbits(np.unpackbits(values[..., None].astype(np.uint8), axis=-1)[..., -bits:], axis=None)
    rows = packed.reshape(values.shape[0], -1)
    lines = b"".join(b"\0" + row.tobytes() for row in rows)
    head = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], bits, 0, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(lines)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in parts
    )


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_labels_of_few_bits_are_the_numbers_that_were_written(tmp_path: Path, bits: int) -> None:
    labels = np.tile(np.arange(64) // 4, (48, 1)) % 2**bits
    (tmp_path / "color").mkdir()
    (tmp_path / "color" / "a_label.png").write_bytes(png_of(bits, labels))
    frame = pair(tmp_path, None, lambda path: write_image(path, FRAME.color))
    np.testing.assert_array_equal(frame.labels, labels)


def test_a_tiff_of_half_precision_is_said_to_be_of_a_kind_that_is_not_read(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(RecordingFormatError, match="of a kind that is not read; save"):
        pair(tmp_path, lambda path: tifffile.imwrite(path, (FRAME.depth_mm / 1000).astype(np.float16)))
    # Decoders would write reports of their own.
    assert capfd.readouterr().err == ""
