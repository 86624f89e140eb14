"""Facts are stated by a format or by the user, and asked for where they are not: unit, cameras, transform."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_scene import CAMERA, scene, write_image, write_mcap, write_tum

from nurbseg.common.frame import Calibration
from nurbseg.drivers import CalibrationError, RecordingFormatError, SourceOptions, open_source
from nurbseg.drivers.calibration.file import write_calibration
from nurbseg.drivers.datasets.beside import NAMES

K = (52.5, 52.5, 31.5, 23.5)
GIVEN = SourceOptions(intrinsics=K)
DEPTH_MM = scene(0).depth_mm
TOML = "registered = true\n{}[color]\nfx = 52.5\nfy = 52.5\ncx = 31.5\ncy = 23.5\n"


def write(folder: Path, depth: np.ndarray, extension: str = "png") -> Path:
    write_image(folder / "a_color.png", scene(0).color)
    if extension == "npy":
        np.save(folder / "a_depth.npy", depth)
    else:
        write_image(folder / f"a_depth.{extension}", depth)
    return folder


def read(folder: Path, options: SourceOptions | None = GIVEN) -> tuple[np.ndarray, str]:
    """Return the depth of the first frame, and the unit that it was read in."""
    with open_source(folder, options) as source:
        assert source.metadata["depth_unit"] == str(source.depth_unit)
        return source.read().depth_mm, str(source.depth_unit)


@pytest.mark.parametrize(("dtype", "extension"), [("<u2", "png"), ("<u2", "npy"), ("<f4", "tiff")])
@pytest.mark.parametrize(
    ("per_meter", "by_toml", "by_user", "who"),
    [
        (None, None, None, "the default for {}"),
        (4000, 4000, None, "camera.toml: depth_scale"),
        (2500, None, 2500, "--depth-scale"),
        (2500, 4000, 2500, "--depth-scale, against 4000 per meter (camera.toml: depth_scale)"),
    ],
)
def test_the_unit_is_stated_or_millimeters_or_meters(
    tmp_path, dtype: str, extension: str, per_meter, by_toml, by_user, who: str
) -> None:
    default, of = (1000, "whole numbers") if dtype == "<u2" else (1, "floating point")
    per_meter = per_meter or default
    write(tmp_path, (DEPTH_MM * (per_meter / 1000) + (0.5 if dtype == "<u2" else 0)).astype(dtype), extension)
    (tmp_path / "camera.toml").write_text(TOML.format(f"depth_scale = {by_toml}\n" if by_toml else ""))
    for intrinsics in (None, K):
        found, unit = read(tmp_path, SourceOptions(intrinsics=intrinsics, depth_scale=by_user))
        np.testing.assert_array_equal(found, DEPTH_MM)
        assert unit == f"{per_meter} per meter ({who.format(of)})"


#: Depth that is implausible in the default unit, what is said of it, and the unit that the message suggests.
IMPLAUSIBLE = {
    "far": (DEPTH_MM * 7 + DEPTH_MM % 2, "half of the depth is beyond 10 m", 5000),
    "near": (DEPTH_MM // 20, "half of the depth is nearer than 0.1 m", 100),
    "float mm": (DEPTH_MM.astype(np.float32), "half of the depth is beyond 10 m", 1000),
    "TUM": (DEPTH_MM // 2 * 5, "all depth is a multiple of 5", 5000),
    # Millimeters rotated by three bits.
    "SUN": (DEPTH_MM // 2 << 3, "all depth is a multiple of 8", 8000),
}


@pytest.mark.parametrize("kind", ["far", "near", "float mm", "TUM", "SUN"])
def test_implausible_depth_is_refused_until_its_unit_is_stated(tmp_path: Path, kind: str) -> None:
    depth, what, suggested = IMPLAUSIBLE[kind]
    folder = write(tmp_path / "a", depth, "npy")
    with pytest.raises(
        RecordingFormatError, match=rf"{what} in the default unit.*--depth-scale {suggested} "
    ):
        open_source(folder, GIVEN)
    default = 1 if depth.dtype == np.float32 else 1000
    for stated in (suggested, default):
        _, unit = read(folder, SourceOptions(intrinsics=K, depth_scale=stated))
        assert unit == f"{stated} per meter (--depth-scale)"
    (folder / "camera.toml").write_text(TOML.format(f"depth_scale = {default}\n"))
    read(folder, None)


@pytest.mark.parametrize("form", ["TUM", "MCAP"])
def test_a_format_that_states_its_unit_is_not_doubted(tmp_path: Path, form: str) -> None:
    far = [scene(0)]
    object.__setattr__(far[0], "depth_mm", DEPTH_MM // 5 * 5 * 3)
    made = write_tum(tmp_path, far) if form == "TUM" else write_mcap(tmp_path / "a.mcap", far)
    found, _ = read(made, None)
    np.testing.assert_array_equal(found, far[0].depth_mm)


@pytest.mark.parametrize(
    "depth",
    [
        DEPTH_MM,
        # 31 distinct values that share a factor, as of a few rendered walls, and no depth at all.
        np.repeat(np.arange(1000, 4100, 100, dtype=np.uint16), 100)[:3072].reshape(48, 64),
        np.zeros((48, 64), np.uint16),
        np.full((48, 64), 65535, np.uint16),
        # Less than half is beyond 10 m.
        np.where(np.arange(3072).reshape(48, 64) < 1300, 20_001, DEPTH_MM).astype(np.uint16),
    ],
    ids=["plain", "walls", "none", "saturated", "some far"],
)
def test_plausible_depth_needs_no_unit(tmp_path: Path, depth: np.ndarray) -> None:
    found, _ = read(write(tmp_path, depth))
    np.testing.assert_array_equal(found, np.where(depth == 65535, 0, depth))


def test_the_values_in_the_messages_can_be_copied(tmp_path: Path) -> None:
    folder = write(tmp_path, DEPTH_MM // 2 * 5)
    given: dict[str, Any] = {}
    for flag in ("intrinsics", "depth_scale"):
        with pytest.raises(RecordingFormatError) as refused:
            open_source(folder, SourceOptions(**given))
        (text,) = re.findall(rf"--{flag.replace('_', '-')} ([\d.,]+)(?= \(or|, or)", str(refused.value))
        numbers = tuple(map(float, text.split(",")))
        given[flag] = numbers if flag == "intrinsics" else numbers[0]
    read(folder, SourceOptions(**given))


def test_only_a_few_names_are_calibrations_beside_images(tmp_path: Path, caplog) -> None:
    write(tmp_path, DEPTH_MM)
    for name in ("calib.xml", "TUM1.yaml", "K.txt", "camera.json", "cameras.txt"):
        (tmp_path / name).write_text("52.5 52.5 31.5 23.5\n")
    with pytest.raises(CalibrationError, match=rf"no calibration: .*{re.escape(', '.join(NAMES))}"):
        open_source(tmp_path)
    read(tmp_path, SourceOptions(calibration=tmp_path / "K.txt"))
    (tmp_path / "camera-intrinsics.txt").write_text("52.5 52.5 31.5 23.5\n")
    read(tmp_path, None)
    (tmp_path / "intrinsics.txt").write_text("60 60 31.5 23.5\n")
    with open_source(tmp_path) as source:
        assert source.calibration.depth.fx == 60.0
    assert "intrinsics.txt counts; not read: camera-intrinsics.txt" in caplog.text


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.yaml", "cam0:\n  camera_model: pinhole\n  intrinsics: [1, 1, 1, 1]\n"),  # Kalibr
        ("a.yaml", "%YAML:1.0\nCamera.fx: 1\nCamera.fy: 1\n"),  # ORB-SLAM
        ("a.json", '{"intrinsic_matrix": [1, 0, 0, 0, 1, 0, 31, 23, 1]}'),  # Open3D
        ("cameras.txt", "# list\n1 PINHOLE 640 480 525 525 320 240\n"),  # COLMAP
        ("a.yaml", "- 1\n"),
        ("a.txt", "1 2 3\n"),
    ],
)
def test_a_calibration_of_another_program_is_refused_with_what_to_do(tmp_path, name: str, text: str):
    folder = write(tmp_path / "a", DEPTH_MM)
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibrationError, match=rf"{re.escape(name)}: .*--intrinsics fx.*camera\.toml"):
        open_source(folder, SourceOptions(calibration=tmp_path / name))


def test_cameras_that_are_over_a_meter_apart_are_refused_with_their_place_in_meters(tmp_path: Path) -> None:
    step = np.eye(4)
    step[:3, 3] = -32.0, 0.5, 0.0
    path = write(tmp_path, DEPTH_MM) / "camera.toml"
    write_calibration(path, Calibration(CAMERA, CAMERA, step))
    with pytest.raises(CalibrationError, match=r"32 m apart; expected 1 m .* in meters: (.*)") as refused:
        open_source(tmp_path)
    # As in the message.
    x, y, _ = str(refused.value).rpartition(": ")[2].split(", ")
    path.write_text(path.read_text().replace("-32.0", x).replace(", 0.5]", f", {y}]"))
    with open_source(tmp_path) as source:
        np.testing.assert_allclose(source.calibration.color_from_depth[:3, 3], [-0.032, 0.0005, 0])
