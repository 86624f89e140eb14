"""Images as other libraries write them: their turns, pages, colors and packed numbers."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from recorded_scene import scene, scenes, write_image

from nurbseg.drivers import RecordingFormatError, SourceOptions, open_source

FRAME = scene(0)
GIVEN = SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))
METERS = (FRAME.depth_mm / 1000).astype(np.float32)


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


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("turn", range(1, 9))
def test_the_pixels_of_a_tiff_stay_where_they_are_stored(tmp_path: Path, turn: int, byteorder: str) -> None:
    tag = [(274, "H", 1, turn, True)]
    frame = pair(
        tmp_path, lambda path: tifffile.imwrite(path, FRAME.depth_mm, byteorder=byteorder, extratags=tag)
    )
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
    frame = pair(tmp_path, None, lambda path: tifffile.imwrite(path, FRAME.color, extratags=tag))
    np.testing.assert_array_equal(frame.color, FRAME.color)


def pages(path: Path, *images: np.ndarray, **preview: int) -> None:
    with tifffile.TiffWriter(path) as writer:
        for number, image in enumerate(images):
            writer.write(image, subfiletype=preview.get(f"of_{number}", 0))


@pytest.mark.parametrize("of", ["", "of_0", "of_1"])
def test_a_tiff_of_several_images_is_one_only_beside_its_preview(tmp_path: Path, of: str) -> None:
    images = [FRAME.depth_mm, scene(1).depth_mm]
    if of:
        images[int(of[-1])] = FRAME.depth_mm[::8, ::8]

    def write(path: Path) -> None:
        pages(path, *images, **({of: 1} if of else {}))

    if of == "of_1":
        np.testing.assert_array_equal(pair(tmp_path, write).depth_mm, FRAME.depth_mm)
        return
    with pytest.raises(RecordingFormatError, match=r"a_depth\.tiff: the TIFF has several images"):
        pair(tmp_path, write)


def lab(path: Path) -> None:
    tifffile.imwrite(path, FRAME.color, photometric="cielab")


def dark(path: Path) -> None:
    path.write_bytes(b"P6\n64 48\n1023\n" + (FRAME.color.astype(">u2") * 4).tobytes())


def floating(path: Path) -> None:
    np.save(path, FRAME.color / 255)


def planes(path: Path) -> None:
    np.save(path, FRAME.color.transpose(2, 0, 1))


@pytest.mark.parametrize(
    ("color", "extension", "said"),
    [
        (lab, "tiff", r"a_color\.tiff: PhotometricInterpretation: expected gray or RGB, got 8"),
        (dark, "ppm", r"a_color\.ppm: maximum: expected 255 or 65535 for color, got 1023"),
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


@pytest.mark.parametrize("alpha", [None, 200, 255])
def test_four_bytes_of_a_pixel_are_a_number_if_they_are_no_color(tmp_path: Path, alpha: int | None) -> None:
    # As TartanAir stores depth: OpenCV wrote the bytes of a pixel as blue, green, red and alpha.
    pixels = METERS.view(np.uint8).reshape(48, 64, 4)[..., [2, 1, 0, 3]].copy()
    if alpha is not None:
        pixels[:, ::2, 3] = alpha

    def write(path: Path) -> None:
        Image.fromarray(pixels, "RGBA").save(path)

    if alpha is None:
        np.testing.assert_array_equal(pair(tmp_path, write, extension="png").depth_mm, FRAME.depth_mm)
        return
    with pytest.raises(RecordingFormatError, match="got 4 of 8 bits; colors are depth as it is shown"):
        pair(tmp_path, write, extension="png")


@pytest.mark.parametrize("alpha", [0, 100, 255])
@pytest.mark.parametrize(
    ("extra", "dtype"), [("unassalpha", np.uint8), (0, np.uint8), ("unassalpha", np.uint16)]
)
def test_the_alpha_of_a_tiff_does_not_darken_its_colors(tmp_path: Path, alpha: int, extra, dtype) -> None:
    pixels = np.dstack([FRAME.color, np.full((48, 64), alpha)]).astype(dtype) * (
        257 if dtype == np.uint16 else 1
    )

    def write(path: Path) -> None:
        tifffile.imwrite(path, pixels.astype(dtype), photometric="rgb", extrasamples=[extra])

    np.testing.assert_array_equal(pair(tmp_path, None, write).color, FRAME.color)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
def test_color_in_a_tiff_of_other_numbers_is_said_to_need_8_bits(tmp_path: Path, dtype) -> None:
    def write(path: Path) -> None:
        tifffile.imwrite(path, FRAME.color.astype(dtype), photometric="rgb")

    with pytest.raises(RecordingFormatError, match=r"a_color\.tiff: .* not read: .* or tiles, as 8 bits"):
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
    with pytest.raises(RecordingFormatError, match="a kind of TIFF that is not read: save it without"):
        pair(tmp_path, lambda path: tifffile.imwrite(path, METERS.astype(np.float16)))
    # Decoders would write reports of their own.
    assert capfd.readouterr().err == ""


def test_the_gray_images_of_a_bop_scene_are_color(tmp_path: Path) -> None:
    write_image(tmp_path / "gray" / "000000.tif", FRAME.color[..., 0])
    write_image(tmp_path / "depth" / "000000.tif", FRAME.depth_mm)
    with open_source(tmp_path, GIVEN) as source:
        (frame,) = source
    np.testing.assert_array_equal(frame.color, np.dstack([FRAME.color[..., 0]] * 3))
