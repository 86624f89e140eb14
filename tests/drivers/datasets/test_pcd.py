"""Organized point clouds: the three forms, the camera found from the points, and damaged files."""

import contextlib
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recorded_scene import CAMERA, back_projected, lzf_literals, scene, write_pcd

from nurbseg.drivers import (
    CalibrationError,
    FrameFormatError,
    RecordingFormatError,
    SourceOptions,
    open_source,
)
from nurbseg.drivers.datasets import pcd_file
from nurbseg.drivers.datasets.pcd import fit_camera
from nurbseg.drivers.datasets.pcd_file import decompress_lzf, read_pcd

FRAME = scene(0)
POINTS_M = back_projected(FRAME)


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_each_form_gives_the_images_it_was_made_from(tmp_path: Path, form) -> None:
    path = write_pcd(tmp_path / "a.pcd", POINTS_M, FRAME.color, form)
    with open_source(path) as source:
        (frame,) = list(source)
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
    np.testing.assert_array_equal(frame.color, FRAME.color)
    assert frame.calibration.is_registered
    assert frame.name == "a"
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(frame.calibration.depth, name) == pytest.approx(getattr(CAMERA, name), abs=1e-4)


@pytest.mark.parametrize("axes", ["body", "OpenGL"])
def test_points_in_other_axes_are_brought_to_the_cameras(tmp_path: Path, axes: str) -> None:
    x, y, z = np.moveaxis(POINTS_M, -1, 0)
    # X is forward, y left and z up; or x right, y up and z backward.
    points_m = np.stack([z, -x, -y] if axes == "body" else [x, -y, -z], axis=-1)
    path = write_pcd(tmp_path / "a.pcd", points_m, FRAME.color, "binary")
    for options in (SourceOptions(), SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))):
        with open_source(path, options) as source:
            np.testing.assert_array_equal(source.read().depth_mm, FRAME.depth_mm)
            assert np.allclose(source.calibration.depth.matrix, CAMERA.matrix, atol=1e-3)


def test_other_fields_padding_and_counts_are_passed_over(tmp_path: Path) -> None:
    table = np.zeros(
        (48, 64),
        [
            ("_", "u1", 4),
            ("normal", "<f4", 3),
            ("x", "<f8"),
            ("more", "u1", 2),
            ("y", "<f4"),
            ("z", "<f4"),
            ("rgba", "<u4", 2),
        ],
    )
    for axis, name in enumerate("xyz"):
        table[name] = POINTS_M[..., axis]
    table["rgba"] = 0xFF102030, 0xFF405060
    head = (
        "VERSION .7\nFIELDS _ normal x _ y z rgba\nSIZE 1 4 8 1 4 4 4\nTYPE U F F U F F U\n"
        "COUNT 4 3 1 2 1 1 2\nWIDTH 64\nHEIGHT 48\nPOINTS 3072\nDATA binary\n"
    )
    (tmp_path / "a.pcd").write_bytes(head.encode() + table.tobytes())
    cloud = read_pcd(tmp_path / "a.pcd")
    np.testing.assert_allclose(cloud.points_m, POINTS_M)
    assert cloud.color is not None
    assert (cloud.color == (0x10, 0x20, 0x30)).all()
    columns = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names)
    packed = lzf_literals(columns)
    head = head.replace("DATA binary", "DATA binary_compressed")
    sizes = len(packed).to_bytes(4, "little") + len(columns).to_bytes(4, "little")
    (tmp_path / "b.pcd").write_bytes(head.encode() + sizes + packed)
    numbers = np.concatenate([table[name].reshape(3072, -1) for name in table.dtype.names], axis=1)
    text = " ".join(map(repr, numbers.ravel().tolist()))
    (tmp_path / "c.pcd").write_text(head.replace("binary_compressed", "ascii") + text)
    for name in ("b.pcd", "c.pcd"):
        other = read_pcd(tmp_path / name)
        np.testing.assert_array_equal(other.points_m, cloud.points_m)
        np.testing.assert_array_equal(other.color, cloud.color)


def test_text_takes_more_memory_than_its_numbers(tmp_path: Path) -> None:
    head = (
        "VERSION .7\nFIELDS x y z _\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 20\n"
        "WIDTH 4096\nHEIGHT 2048\nPOINTS 8388608\nDATA "
    )
    path = tmp_path / "a.pcd"
    path.write_text(f"{head}binary\n")
    with pytest.raises(FrameFormatError, match="cut off: 0 bytes of 268435456"):
        read_pcd(path)
    path.write_text(f"{head}ascii\n")
    with pytest.raises(FrameFormatError, match="268435456 bytes at most, got 8388608 points of 184"):
        read_pcd(path)


def test_clouds_without_color_are_gray(tmp_path: Path) -> None:
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 64\nHEIGHT 48\nPOINTS 3072\nDATA binary\n"
    )
    (tmp_path / "a.pcd").write_bytes(head.encode() + POINTS_M.tobytes())
    with open_source(tmp_path / "a.pcd") as source:
        frame = source.read()
    assert (frame.color == 128).all()
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)


def test_a_flipped_camera_has_a_negative_fy() -> None:
    assert fit_camera(POINTS_M * np.float32([1, -1, 1]), "a").fy == pytest.approx(-CAMERA.fy, abs=1e-4)


def test_points_that_no_pinhole_camera_sees_are_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(CalibrationError, match=r"a: x: the points do not lie on .* --intrinsics"):
        fit_camera(rng.uniform(0.5, 1, (48, 64, 3)).astype(np.float32), "a")


def lens_cloud(width: int, distortion: list[float], turn_deg: float, rounded: bool, part: int) -> np.ndarray:
    """Return the points of a curved wall, turned about the axis that points right."""
    height, focal = width * 3 // 4, 0.82 * width
    v, u = np.mgrid[:height, :width].astype(np.float64)
    matrix = np.array([[focal, 0, width / 2 - 3], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)[:, None]
    rays = cv2.convertPointsToHomogeneous(cv2.undistortPoints(pixels, matrix, np.array(distortion)))[:, 0]
    points = rays * (1.5 + 0.3 * np.sin(7 * rays[:, :1]) + 0.4 * rays[:, 1:2])
    points = points @ cv2.Rodrigues(np.array([np.radians(turn_deg), 0, 0]))[0].T
    points = np.rint(points * 1000) / 1000 if rounded else points
    points = points.reshape(height, width, 3).astype(np.float32)
    points[height // part :] = points[:, width // part :] = np.nan
    return points


@pytest.mark.parametrize("width", [80, 640])
@pytest.mark.parametrize(("turn_deg", "rounded"), [(0.5, False), (-1.0, True), (2.0, True)])
def test_clouds_that_were_turned_are_refused_whatever_their_size(width: int, turn_deg, rounded) -> None:
    with pytest.raises(CalibrationError, match=r"a: x, y, z: the points are turned .* camera's own frame"):
        fit_camera(lens_cloud(width, [0.0] * 5, turn_deg, rounded, 1), "a")


@pytest.mark.parametrize("width", [80, 1280])
@pytest.mark.parametrize("part", [1, 2])
@pytest.mark.parametrize(
    "distortion",
    [
        [0.2624, -0.9531, -0.0054, 0.0026, 1.1633],  # a Kinect's color camera, in TUM RGB-D
        [-0.056, 0.068, 0.0006, -0.0001, -0.021],  # a RealSense D435's
        [0.0] * 5,
    ],
)
def test_the_distortion_of_a_lens_and_rounding_are_no_turn(width: int, part: int, distortion) -> None:
    camera = fit_camera(lens_cloud(width, distortion, 0.0, rounded=True, part=part), "a")
    assert camera.fx == pytest.approx(0.82 * width, rel=0.05)


def test_a_large_cloud_takes_little_more_memory_than_its_file(tmp_path: Path, monkeypatch) -> None:
    v, u = np.mgrid[:1024, :1024].astype(np.float32)
    points_m = np.stack([(u - 512) / 800, (v - 512) / 800, np.ones_like(u)], axis=-1)
    path = write_pcd(tmp_path / "a.pcd", points_m, np.zeros((1024, 1024, 3), np.uint8), "binary")
    # It makes room for the largest file first.
    monkeypatch.setattr(pcd_file, "read_file", lambda path, *_, **__: path.read_bytes())
    tracemalloc.start()
    try:
        with open_source(path) as source:
            source.read()
        assert tracemalloc.get_traced_memory()[1] < 4 * path.stat().st_size
    finally:
        tracemalloc.stop()


def test_too_few_points_for_a_camera_are_said_and_a_given_one_is_taken(tmp_path: Path) -> None:
    points_m = np.full_like(POINTS_M, np.nan)
    points_m[0, :50] = POINTS_M[0, :50]
    path = write_pcd(tmp_path / "a.pcd", points_m, FRAME.color, "binary")
    with pytest.raises(CalibrationError, match=r"a\.pcd: .*points with z > 0 are too few.*--intrinsics"):
        open_source(path)
    with open_source(path, SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))) as source:
        assert source.read().calibration.depth.fx == 52.5


def replaced(path: Path, old: str, new: str) -> None:
    content = path.read_bytes()
    assert old.encode() in content
    path.write_bytes(content.replace(old.encode(), new.encode(), 1))


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("WIDTH 64\nHEIGHT 48", "WIDTH 3072\nHEIGHT 1", r"HEIGHT: the cloud is not organized \(3072x1\)"),
        ("HEIGHT 48", "HEIGHT many", "HEIGHT: expected 1 to 16777216, got 'many'"),
        ("POINTS 3072", "POINTS 3000", "POINTS: expected WIDTH x HEIGHT = 3072"),
        ("FIELDS x y z rgb", "FIELDS x y w rgb", "FIELDS: z missing"),
        ("SIZE 4 4 4 4", "SIZE 4 4 4", "FIELDS, SIZE, TYPE, COUNT"),
        ("SIZE 4 4 4 4", "SIZE 4 4 3 4", "TYPE, SIZE: z: unknown number F of 3"),
        ("COUNT 1 1 1 1", "COUNT 1 1 2 1", "FIELDS: z: expected once"),
        ("DATA binary", "DATA hexdump", "DATA: expected ascii, binary"),
        ("TYPE F F F F\n", "", "TYPE: missing"),
    ],
)
def test_a_header_that_is_wrong_is_named_by_its_field(tmp_path: Path, old: str, new: str, text: str) -> None:
    path = write_pcd(tmp_path / "a.pcd", POINTS_M, FRAME.color, "binary")
    replaced(path, old, new)
    with pytest.raises(FrameFormatError, match=rf"a\.pcd: {text}"):
        read_pcd(path)
    with pytest.raises(RecordingFormatError, match=rf"none of the 1 frames.*a\.pcd: {text}"):
        open_source(path)


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("part", [0.02, 0.5, 0.99])
def test_a_cloud_that_is_cut_off_is_refused(tmp_path: Path, form, part: float) -> None:
    path = write_pcd(tmp_path / "a.pcd", POINTS_M, FRAME.color, form)
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(FrameFormatError, match=r"a\.pcd: DATA"):
        read_pcd(path)


def test_one_bad_cloud_of_a_folder_is_named_and_the_run_continues(tmp_path: Path) -> None:
    for number in (0, 1, 2, 10):
        write_pcd(tmp_path / f"c{number}.pcd", POINTS_M, FRAME.color, "binary")
    (tmp_path / "c1.pcd").write_bytes((tmp_path / "c1.pcd").read_bytes()[:500])
    with open_source(tmp_path) as source:
        assert source.read().name == "c0"
        with pytest.raises(FrameFormatError, match=r"c1\.pcd"):
            source.read()
        assert [frame.name for frame in source] == ["c2", "c10"]


def test_references_back_repeat_what_was_written() -> None:
    # Two literals, then 9 bytes from 2 back; then, long, 264 bytes from 1 back.
    assert decompress_lzf(b"\x01ab\xe0\x00\x01", 11) == b"ab" + b"ababababa"
    assert decompress_lzf(b"\x00z\xe0\xff\x00", 265) == b"z" * 265
    assert decompress_lzf(b"\x03abcd\x20\x03\x00x", 8) == b"abcdabcx"


def compressed(content: bytes) -> bytes:
    """Compress by references, as greedily as a few lines can."""
    out, literals, place = b"", b"", 0

    def flushed() -> bytes:
        return b"".join(lzf_literals(literals[n : n + 32]) for n in range(0, len(literals), 32))

    while place < len(content):
        best, back = 0, 0
        for distance in range(1, min(place, 64) + 1):
            length = 0
            while place + length < len(content) and length < 264:
                if content[place + length] != content[place + length - distance]:
                    break
                length += 1
            if length > best:
                best, back = length, distance
        if best < 3:
            literals += content[place : place + 1]
            place += 1
            continue
        out += flushed()
        literals = b""
        size, offset = best - 2, back - 1
        head = bytes([min(size, 7) << 5 | offset >> 8]) + (bytes([size - 7]) if size >= 7 else b"")
        out += head + bytes([offset & 255])
        place += best
    return out + flushed()


@given(st.lists(st.sampled_from([b"a", b"ab", b"abc" * 5, bytes(300), b"xyz"]), max_size=20).map(b"".join))
def test_what_is_compressed_comes_back(content: bytes) -> None:
    assert decompress_lzf(compressed(content), len(content)) == content


@given(st.binary(max_size=60), st.integers(0, 200))
def test_any_bytes_are_decompressed_or_refused(content: bytes, size: int) -> None:
    with contextlib.suppress(ValueError):
        assert len(decompress_lzf(content, size)) == size
