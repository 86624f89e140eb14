"""Calibration files: each form is read, ours is written, and an unusable value is named."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from recorded_scene import APART, CAMERA, REGISTERED, write_opencv

from nurbseg.drivers import Calibration, CalibrationError
from nurbseg.drivers.calibration.file import read_camera_file

MATRIX = "52.5 0 31.5\n0 52.6 23.5\n0 0 1\n"
TOML = """
color_from_depth = [[1, 0, 0, -0.025], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
[depth]
width = 64
height = 48
fx = 57.6
fy = 57.6
cx = 31.5
cy = 23.1
distortion = [0.1, 0.2, 0.0, 0.0, 0.3]
[color]
width = 64
height = 48
fx = 52.5
fy = 52.5
cx = 31.5
cy = 23.5
"""
ROS = """
image_width: 64
image_height: 48
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [52.5, 0, 31.5, 0, 52.6, 23.5,
         0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.07, -0.03, -0.01, 0.0, -0.14]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [52.5, 0, 31.5, 0, 0, 52.6, 23.5, 0, 0, 0, 1, 0]
"""


def assert_same(one: Calibration, other: Calibration) -> None:
    np.testing.assert_allclose(one.color_from_depth, other.color_from_depth, atol=1e-12)
    for name in ("depth", "color"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a.width, a.height) == (b.width, b.height)
        np.testing.assert_array_equal(a.matrix, b.matrix)
        np.testing.assert_array_equal(a.distortion, b.distortion)


@pytest.mark.parametrize("calibration", [REGISTERED, APART], ids=["registered", "apart"])
@pytest.mark.parametrize("name", ["a.xml", "a.yml", "a.yaml"])
def test_what_opencv_writes_is_read(tmp_path: Path, calibration: Calibration, name: str) -> None:
    path = write_opencv(tmp_path / name, calibration)
    assert_same(read_camera_file(path).calibration(), calibration)
    # As some editors leave it.
    path.write_text(f"\ufeff\n{path.read_text()}")
    assert_same(read_camera_file(path).calibration(), calibration)


def test_a_ros_camera_info_stands_for_both_cameras(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(ROS)
    calibration = read_camera_file(tmp_path / "camera.yaml").calibration()
    assert calibration.is_registered
    assert calibration.color.fy == 52.6
    assert calibration.color.distortion.tolist() == [0.07, -0.03, -0.01, 0.0, -0.14]


@pytest.mark.parametrize("model", ["", "none", "pinhole", "Brown Conrady", "equidistant"])
@pytest.mark.parametrize("count", [4, 5, 6, 10])
def test_a_lens_model_whose_coefficients_are_zeros_is_none(tmp_path: Path, model: str, count: int) -> None:
    coefficients = f"cols: {count}\n  data: {[0.0] * count}"
    text = ROS.replace("cols: 5\n  data: [0.07, -0.03, -0.01, 0.0, -0.14]", coefficients)
    (tmp_path / "a.yaml").write_text(text.replace("plumb_bob", model))
    assert read_camera_file(tmp_path / "a.yaml").calibration().color.distortion.size == 0


def test_a_message_printed_by_ros_is_understood(tmp_path: Path) -> None:
    (tmp_path / "info.yaml").write_text(
        "header:\n  frame_id: optical\nheight: 48\nwidth: 64\ndistortion_model: plumb_bob\n"
        "d:\n- 0.1\n- -0.2\n- 0.0\n- 0.0\n- 0.0\n"
        "k:\n- 52.5\n- 0.0\n- 31.5\n- 0.0\n- 52.6\n- 23.5\n- 0.0\n- 0.0\n- 1.0\n---\nheight: 48\n"
    )
    camera = read_camera_file(tmp_path / "info.yaml").calibration().depth
    assert (camera.width, camera.fy, camera.distortion[1]) == (64, 52.6, -0.2)


def test_a_calibration_of_one_camera_by_opencv_stands_for_both(tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / "a.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 64)
    storage.write("image_height", 48)
    storage.write("camera_matrix", CAMERA.matrix)
    storage.release()
    assert_same(read_camera_file(tmp_path / "a.yml").calibration(), REGISTERED)


@pytest.mark.parametrize(
    "text",
    [
        MATRIX,
        MATRIX.replace(" ", ", "),
        f"# pixels\n\n{MATRIX}",
        "52.5 52.6 31.5 23.5",
        "52.5 0 31.5 0 52.6 23.5 0 0 1",
        "52.5 0 31.5 0\n0 52.6 23.5 0\n0 0 1 0\n0 0 0 1\n",
    ],
)
def test_a_matrix_as_text_needs_the_images_size(tmp_path: Path, text: str) -> None:
    (tmp_path / "intrinsics.txt").write_text(text)
    calibration = read_camera_file(tmp_path / "intrinsics.txt").calibration(
        depth_size=(64, 48), color_size=(64, 48)
    )
    assert calibration.is_registered
    assert calibration.depth.fy == 52.6
    with pytest.raises(
        CalibrationError, match=r"intrinsics\.txt: camera matrix: width and height are missing"
    ):
        read_camera_file(tmp_path / "intrinsics.txt").calibration()


@pytest.mark.parametrize(
    ("depth", "color", "rotation", "translation"),
    [
        (
            ("IR_intrinsic_params", "IR_distortion_coefficients"),
            ("RGB_intrinsic_params", "RGB_distortion_coefficients"),
            "Rotation",
            "Translation",
        ),
        (("M1", "D1"), ("M2", "D2"), "R", "T"),
        (("cameraMatrix1", "distCoeffs1"), ("cameraMatrix2", "distCoeffs2"), "R", "T"),
        (("depth_intrinsics", "depth_distortion"), ("rgb_intrinsics", "rgb_distortion"), "R", "T"),
    ],
)
@pytest.mark.parametrize("vector", [False, True], ids=["matrix", "vector"])
def test_a_stereo_calibration_of_opencv_is_read_under_its_many_names(
    tmp_path: Path, depth, color, rotation: str, translation: str, vector: bool
) -> None:
    path = tmp_path / "calib.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for (matrix_name, distortion_name), camera in ((depth, APART.depth), (color, APART.color)):
        storage.write(matrix_name, camera.matrix)
        storage.write(distortion_name, camera.distortion.reshape(1, -1))
    turn = APART.color_from_depth[:3, :3].copy()
    storage.write(rotation, cv2.Rodrigues(turn)[0] if vector else turn)
    # CAPE's lengths are millimeters.
    unit = 1000.0 if translation == "Translation" else 1.0
    storage.write(translation, APART.color_from_depth[:3, 3:] * unit)
    storage.release()
    assert_same(read_camera_file(path).calibration(depth_size=(64, 48), color_size=(80, 60)), APART)


def test_intrinsics_are_scaled_to_images_of_the_same_shape_and_refused_for_others(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(TOML)
    scaled = read_camera_file(tmp_path / "a.toml").calibration(depth_size=(32, 24), color_size=(640, 480))
    assert scaled.depth.fx == 28.8
    assert scaled.depth.cx == 15.5
    assert scaled.color.fx == 525.0
    with pytest.raises(CalibrationError, match=r"a\.toml: color: the camera of 64x48 images .* 1280x1024"):
        read_camera_file(tmp_path / "a.toml").calibration(depth_size=(64, 48), color_size=(1280, 1024))


def toml(old: str, new: str) -> str:
    assert old in TOML
    return TOML.replace(old, new, 1)


def ros(old: str, new: str) -> str:
    assert old in ROS
    return ROS.replace(old, new, 1)


SIZE_AND_FX, DISTORTION, ROW = "height = 48\nfx = 57.6", "[0.1, 0.2, 0.0, 0.0, 0.3]", "[[1, 0, 0, -0.025]"
OPENCV, NO_DEPTH = "%YAML:1.0\n---\n", "depth: the table is missing; one camera needs registered"
RAYS = "depth: distortion: expected rays for most pixels of a 64x48 image"
EMPTY = '<?xml version="1.0"?><opencv_storage></opencv_storage>'
#: The end of a file's name, its content, and what is said of it.
UNUSABLE: list[tuple[str, str | bytes | None, str]] = [
    ("toml", toml("fx = 57.6", "fx = nan"), r"depth\.fx: expected a finite number, got nan"),
    ("toml", toml("cy = 23.5", "cy = inf"), r"color\.cy: expected a finite number, got inf"),
    ("toml", toml("fx = 57.6", "fx = '57.6'"), r"depth\.fx: expected a finite number, got '57\.6'"),
    ("toml", toml("fx = 57.6", "fx = -57.6"), "depth: fx, fy: expected focal lengths"),
    ("toml", toml("fx = 57.6\n", ""), r"depth\.fx: missing"),
    ("toml", toml("fx = 57.6", "fx = 57.6\nskew = 0.1"), r"depth\.skew: unknown; expected one of cx, cy"),
    ("toml", toml("cx = 31.5", "cx = 70"), r"depth: the principal point 70, 23\.1 is outside .*64x48"),
    ("toml", toml("height = 48", "height = 48.5"), r"depth\.height: expected whole pixels, got 48\.5"),
    ("toml", toml(SIZE_AND_FX, "fx = 57.6"), r"depth\.height: expected whole pixels, got None"),
    ("toml", toml(DISTORTION, "[0.1, 0.2, nan, 0.0, 0.3]"), r"depth\.distortion: expected a finite"),
    ("toml", toml(DISTORTION, "[1e200, 1e200, 0.0, 0.0, 1e200]"), RAYS),
    ("toml", toml(DISTORTION, "[-50.0, 300.0, 0.0, 0.0, -1000.0]"), RAYS),
    ("toml", toml(DISTORTION, "[0.1, 0.2]"), "depth: distortion: expected .* got 2"),
    ("toml", toml(ROW, "[[1, 0, 0, nan]"), "color_from_depth: expected a finite number"),
    ("toml", toml(ROW, "[[1, 0, 0]"), "color_from_depth: expected 4 rows of 4"),
    ("toml", toml(ROW, "[[2, 0, 0, -0.025]"), "color_from_depth: expected a rigid transform"),
    ("toml", toml("[color]", "[colour]"), "colour: unknown"),
    ("toml", f"registered = true{TOML}", "color_from_depth: registered images have none"),
    ("toml", f"depth_scale = 0{TOML}", "depth_scale: expected units per meter over 0"),
    ("toml", f"registered = 1{TOML}", "registered: expected true or false"),
    ("toml", toml("[depth]", "[depth"), "not valid TOML"),
    ("toml", "", "color: the table is missing"),
    ("toml", "[color]\nfx = 1\nfy = 1\ncx = 1\ncy = 1\n", NO_DEPTH),
    ("toml", "color = 3\n", r"color: expected a table \[color\]"),
    ("toml", TOML.partition("]]\n")[2], "color_from_depth: missing"),
    ("toml", b"\xff\xfe\x00", "expected text, got bytes that are not UTF-8"),
    ("toml", None, "the calibration cannot be read"),
    ("txt", MATRIX.replace("52.6", "nan"), "camera matrix: expected finite"),
    ("txt", "52.5 0 31.5\n", "camera matrix: expected 3 rows of 3"),
    ("txt", "1 0 2 0\n0 1 2 5\n0 0 1 0\n0 0 0 1\n", "camera matrix: expected a last row 0 0 0 1"),
    ("txt", "1 0 2 0\n0 1 2 0\n0 0 1 0\n", "camera matrix: expected 3 rows of 3 numbers, 4 rows"),
    ("txt", MATRIX.replace("0 0 1", "0 0 2"), "camera matrix: expected the last row 0 0 1"),
    ("yaml", "K: {rows: true, cols: 1, data: [1]}\n", "K: expected rows x cols numbers"),
    ("yaml", ros("52.6, 23.5,", ".nan, 23.5,"), "camera_matrix: expected a finite number, got nan"),
    ("yaml", ros("plumb_bob", "equidistant"), "distortion_model: .*'equidistant'"),
    ("yaml", ros("rows: 3", "rows: 4"), "camera_matrix: expected rows x cols .* got 4 x 3 and 9"),
    ("yaml", f"image_width: 64\nimage_height: 48\nk: {[0] * 9}", "k: the camera is not calibrated"),
    ("yaml", ros("image_width: 64", ""), "image_width: expected whole pixels, got None"),
    ("yaml", "hello: 1\n", "camera_matrix: missing; expected camera_matrix, k or K"),
    ("yaml", "camera_matrix: 7\n", "camera_matrix: expected a matrix or a list of numbers, got 7"),
    ("yaml", "k: [1, 2]\n", "k: expected 9 numbers, got 2"),
    ("yaml", "- 1\n", "expected named matrices, got"),
    ("yaml", "a: [\n", "not valid YAML"),
    ("yml", f"{OPENCV}M1: 7\n", "M1: expected a matrix"),
    ("yml", f"{OPENCV}hello: 7\n", "camera_matrix: missing; .* depth_camera_matrix"),
    ("yml", f"{OPENCV}  a: [\n", "not valid YAML"),
    ("yml", f"{OPENCV}M1: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n", "M2: missing"),
    ("xml", "<rgb><depth>", "not valid XML"),
    ("xml", "<rgb></rgb>", "expected OpenCV's <opencv_storage>, got 'rgb'"),
    ("xml", EMPTY, "camera_matrix: missing; .* depth_camera_matrix"),
]  # fmt: skip


@pytest.mark.parametrize(("form", "content", "text"), UNUSABLE)
def test_an_unusable_file_is_named_with_the_field(tmp_path: Path, form: str, content, text: str) -> None:
    path = tmp_path / f"a.{form}"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(CalibrationError, match=rf"a\.{form}: {text}"):
        read_camera_file(path).calibration(depth_size=(64, 48), color_size=(64, 48))
