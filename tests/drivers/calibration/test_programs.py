"""Calibrations of other programs: each form is read exactly, or refused by the name of the field."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from nurbseg.drivers import CalibrationError
from nurbseg.drivers.calibration.file import read_camera_file, read_depth_unit

SIZE = {"depth_size": (640, 480), "color_size": (640, 480)}
COEFFICIENTS = [0.2, -0.9, -0.005, 0.003, 1.1]
NAMED_COEFFICIENTS = dict(zip(("k1", "k2", "p1", "p2", "k3"), COEFFICIENTS, strict=True))
#: What rs-enumerate-devices -c prints of a camera.
RS_ENUMERATE = """ Intrinsic of "Color" / 640x480 / {{RGB8/BGR8}}
  Width:      \t640
  Height:     \t480
  PPX:        \t319.5
  PPY:        \t239.5
  Fx:         \t525
  Fy:         \t526
  Distortion: \t{}
  Coeffs:     \t{}
  FOV (deg):  \t54.9 x 42.5
"""
PINHOLE = [525, 0, 319.5, 0, 525, 239.5, 0, 0, 1]
KALIBR = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [500.0, 501.0, 320.5, 241.5]
  resolution: [640, 480]
  rostopic: {first}
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.05]
  - [0.0, 1.0, 0.0, 0.01]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: equidistant
  intrinsics: [600.0, 601.0, 639.5, 359.5]
  resolution: [1280, 720]
  rostopic: {second}
timeshift_cam_imu: 0.0
"""
#: As ORB-SLAM2's TUM1.yaml, whose last line OpenCV reads and YAML does not.
ORB_SLAM = """%YAML:1.0

#----
Camera.fx: 517.3
Camera.fy: 516.5
Camera.cx: 318.6
Camera.cy: 255.3

Camera.k1: 0.2
Camera.k2: -0.9
Camera.p1: -0.005
Camera.p2: 0.003
Camera.k3: 1.1

Camera.width: 640
Camera.height: 480
DepthMapFactor: 5000.0
Viewer.PointSize:2
"""
REALSENSE = {"width": 640, "height": 480, "fx": 615.0, "fy": 616.0, "ppx": 321.0, "ppy": 242.0}
SENS = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 1296
m_colorHeight = 968
m_depthWidth = 640
m_depthHeight = 480
m_depthShift = 4000
m_calibrationColorIntrinsic = 1170.19 0 647.75 0 0 1170.18 483.75 0 0 0 1 0 0 0 0 1
m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = 577.87 0 319.5 0 0 577.86 239.5 0 0 0 1 0 0 0 0 1
"""
SCANNET = """appVersionId = 1
colorHeight = 968
colorWidth = 1296
depthHeight = 480
depthShift = 1000
depthWidth = 640
colorToDepthExtrinsics = 1 0 0 0.025 0 1 0 0 0 0 1 0 0 0 0 1
fx_color = 1170.19
fx_depth = 577.87
fy_color = 1170.18
fy_depth = 577.86
mx_color = 647.75
mx_depth = 319.5
my_color = 483.75
my_depth = 239.5
"""


def written(folder: Path, name: str, text: str | dict) -> Path:
    path = folder / name
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    return path


def values(path: Path, name: str = "depth") -> list[float]:
    """Return fx, fy, cx and cy of a camera for images of 640 x 480."""
    camera = getattr(read_camera_file(path).calibration(**SIZE), name)
    return [camera.fx, camera.fy, camera.cx, camera.cy]


@pytest.mark.parametrize(
    ("topics", "depth_first"),
    [
        (("/camera/depth/image", "/camera/rgb/image"), True),
        (("/camera/color/image_raw", "/camera/infra1/image"), False),
        (("/left", "/camera/color/image_raw"), True),
        (("/left", "/right"), True),
    ],
)
def test_kalibr_cameras_are_told_apart_by_topic(
    tmp_path: Path, topics: tuple[str, str], depth_first: bool, caplog: pytest.LogCaptureFixture
) -> None:
    found = read_camera_file(
        written(tmp_path, "camchain.yaml", KALIBR.format(first=topics[0], second=topics[1]))
    )
    calibration = found.calibration()
    first, second = calibration.depth, calibration.color
    if not depth_first:
        first, second = second, first
    assert (first.width, first.fx, first.fy, first.cx, first.cy) == (640, 500.0, 501.0, 320.5, 241.5)
    assert first.distortion.tolist() == [0.1, -0.2, 0.001, -0.002]
    assert (second.width, second.height, second.fx, second.distortion.size) == (1280, 720, 600.0, 0)
    sign = 1 if depth_first else -1
    assert calibration.color_from_depth[:3, 3].tolist() == [sign * -0.05, sign * 0.01, 0.0]
    assert ("taken for the depth camera" in caplog.text) == (topics == ("/left", "/right"))


def test_one_kalibr_camera_and_eurocs_stand_for_both_images(tmp_path: Path) -> None:
    single = KALIBR.format(first="/a", second="/b").partition("cam1:")[0]
    euroc = "camera_model: pinhole\nintrinsics: [500, 501, 320.5, 241.5]\nresolution: [640, 480]\n"
    for text in (
        single,
        euroc + "distortion_model: radtan\ndistortion_coefficients: [0.1, -0.2, 0.001, -0.002]\n",
    ):
        calibration = read_camera_file(written(tmp_path, "a.yaml", text)).calibration()
        assert calibration.is_registered
        assert (calibration.depth.fy, calibration.depth.distortion[1]) == (501.0, -0.2)


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("radtan", "equidistant", "cam0.distortion_model: expected one of"),
        ("camera_model: pinhole", "camera_model: omni", "cam0.camera_model: expected pinhole, got 'omni'"),
        ("T_cn_cnm1", "T_other", "cam1.T_cn_cnm1: missing"),
        ("[500.0, 501.0, 320.5, 241.5]", "[500.0]", "cam0.intrinsics: expected 4 numbers, got 1"),
    ],
)
def test_what_kalibr_says_that_cannot_be_used_is_named(
    tmp_path: Path, old: str, new: str, field: str
) -> None:
    text = KALIBR.format(first="/depth", second="/rgb")
    assert old in text
    with pytest.raises(CalibrationError, match=rf"a\.yaml: {field}"):
        read_camera_file(written(tmp_path, "a.yaml", text.replace(old, new, 1)))


def test_orb_slams_settings_hold_the_camera_and_the_unit(tmp_path: Path) -> None:
    newer = ORB_SLAM.replace("Camera.fx", "Camera1.fx").replace("Camera.fy", "Camera1.fy")
    newer = (
        newer.replace("Camera.c", "Camera1.c")
        .replace("Camera.k", "Camera1.k")
        .replace("Camera.p", "Camera1.p")
    )
    newer = newer.replace("DepthMapFactor", "RGBD.DepthMapFactor")
    for text in (ORB_SLAM, newer):
        path = written(tmp_path, "TUM1.yaml", text)
        assert values(path) == [517.3, 516.5, 318.6, 255.3]
        found = read_camera_file(path)
        assert found.depth.distortion.tolist() == COEFFICIENTS
        assert found.depth_unit is not None and found.depth_unit.units_per_meter == 5000.0
        assert "DepthMapFactor 5000" in str(found.depth_unit)
    with pytest.raises(CalibrationError, match=r"distortion model: .*KannalaBrandt8"):
        read_camera_file(written(tmp_path, "a.yaml", ORB_SLAM + 'Camera.type: "KannalaBrandt8"\n'))


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        # By columns, as Open3D writes it.
        (
            {"width": 640, "height": 480, "intrinsic_matrix": [525, 0, 0, 0, 526, 0, 319.5, 239.5, 1]},
            [525, 526, 319.5, 239.5],
        ),
        # By rows, as other programs do.
        ({"intrinsic_matrix": [[525, 0, 319.5], [0, 526, 239.5], [0, 0, 1]]}, [525, 526, 319.5, 239.5]),
        (
            {**REALSENSE, "model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5},
            [615, 616, 321, 242],
        ),
        ({"color": REALSENSE}, [615, 616, 321, 242]),
        (
            {
                "camera": {
                    "w": 640,
                    "h": 480,
                    "fx": 600.0,
                    "fy": 601.0,
                    "cx": 319.5,
                    "cy": 239.5,
                    "scale": 6553.5,
                }
            },
            [600, 601, 319.5, 239.5],
        ),
        (
            {
                "fl_x": 500.0,
                "fl_y": 501.0,
                "cx": 320.0,
                "cy": 240.0,
                "w": 640,
                "h": 480,
                "camera_model": "OPENCV",
            },
            [500, 501, 320, 240],
        ),
        (
            {
                "camera_matrix": [[525, 0, 319.5], [0, 526, 239.5], [0, 0, 1]],
                "dist_coeff": [[0.1, 0, 0, 0, 0]],
            },
            [525, 526, 319.5, 239.5],
        ),
        (
            {
                "cx": 325.5,
                "cy": 253.5,
                "depth_scale": 0.1,
                "fx": 518.0,
                "fy": 519.0,
                "height": 480,
                "width": 640,
            },
            [518, 519, 325.5, 253.5],
        ),
    ],
)
def test_cameras_in_json_are_read(tmp_path: Path, table: dict, expected: list[float]) -> None:
    assert values(written(tmp_path, "a.json", table)) == expected


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.json", json.dumps({**REALSENSE, "dist": COEFFICIENTS})),
        ("a.json", json.dumps({**REALSENSE, "distortion": NAMED_COEFFICIENTS})),
        ("a.json", json.dumps({"intrinsic": REALSENSE, "distortion": NAMED_COEFFICIENTS})),
        ("a.json", json.dumps({"intrinsic": REALSENSE, "distortion": COEFFICIENTS})),
        (
            "b.txt",
            RS_ENUMERATE.format("Brown Conrady", "  \t".join(map(str, COEFFICIENTS)))
            .replace("525", "615")
            .replace("526", "616")
            .replace("319.5", "321")
            .replace("239.5", "242"),
        ),
        ("a.txt", f"fx = 615\nfy = 616\ncx = 321\ncy = 242\ndistortion = {COEFFICIENTS}\n"),
        # CamOdoCal and VINS-Fusion.
        (
            "a.yaml",
            "%YAML:1.0\n---\nmodel_type: PINHOLE\nimage_width: 640\nimage_height: 480\n"
            + "distortion_parameters:\n"
            + "".join(f"   {key}: {value}\n" for key, value in NAMED_COEFFICIENTS.items())
            + "projection_parameters:\n   fx: 615.0\n   fy: 616.0\n   cx: 321.0\n   cy: 242.0\n",
        ),
    ],
)
def test_distortion_counts_wherever_it_stands(tmp_path: Path, name: str, text: str) -> None:
    path = written(tmp_path, name, text)
    assert values(path) == [615, 616, 321, 242]
    assert read_camera_file(path).depth.distortion.tolist() == COEFFICIENTS
    assert read_camera_file(path).depth.size == (None if name == "a.txt" else (640, 480))


def test_depth_and_color_of_a_dump_are_two_cameras_with_their_transform(tmp_path: Path) -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    table = {
        "depth": REALSENSE,
        "color": {**REALSENSE, "width": 1280, "height": 960, "fx": 1230.0},
        # librealsense keeps matrices by columns.
        "extrinsics": {"rotation": turn.T.ravel().tolist(), "translation": [0.015, 0.0, 0.001]},
        "depth_scale": 0.00025,
    }
    found = read_camera_file(written(tmp_path, "dump.json", table))
    calibration = found.calibration()
    assert (calibration.depth.fx, calibration.color.fx, calibration.color.width) == (615.0, 1230.0, 1280)
    np.testing.assert_array_equal(calibration.color_from_depth[:3, :3], turn)
    assert found.depth_unit is not None and found.depth_unit.units_per_meter == 4000.0
    del table["extrinsics"]
    found = read_camera_file(written(tmp_path, "dump.json", table))
    assert not found.calibration().is_registered


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({**REALSENSE, "model": "Inverse Brown Conrady", "coeffs": COEFFICIENTS}, "distortion model"),
        ({"left": REALSENSE, "right": REALSENSE}, "expected one camera, or one called depth"),
        (
            {"camera_matrix": [1, 0, 2, 0, 1, 2, 0, 0, 1], "distortions": [0.1, 0, 0, 0]},
            "'distortions': unknown",
        ),
        ({**REALSENSE, "radial_distortion": [0.1, 0.2]}, "'radial_distortion': unknown"),
        ({**REALSENSE, "distortion": {"radial": [0.1, 0.2]}}, "distortion: expected a list of numbers"),
        ({"depth": REALSENSE, "color": REALSENSE, "distortion": COEFFICIENTS}, "distortion: beside two"),
        ({"M1": PINHOLE, "dist1": COEFFICIENTS, "M2": PINHOLE}, "'dist1': unknown"),
        ({"K": PINHOLE, "D": [0.1, 0.2, 0.3, 0.4], "fisheye_model": 1}, "distortion_model: .*'fisheye'"),
        ({"CalibrationInformation": {"Cameras": []}}, "factory calibration of an Azure Kinect"),
        ({**REALSENSE, "depth_scale": 50}, "depth_scale: expected units per meter, or a unit in mm"),
        ({"camera_matrix": [525, 3, 319, 0, 525, 239, 0, 0, 1]}, "expected no skew"),
        ({"fx": 525.0}, "fy: missing"),
    ],
)
def test_what_would_be_read_wrong_is_refused(tmp_path: Path, table: dict, text: str) -> None:
    with pytest.raises(CalibrationError, match=text):
        read_camera_file(written(tmp_path, "a.json", table))


@pytest.mark.parametrize(
    ("field", "value", "per_metre"),
    [
        ("depth_scale", 1000.0, 1000.0),
        ("factor_depth", 4.0, 4.0),
        ("depth_scale", 0.001, 1000.0),
        ("depth_scale", 0.1, 10_000.0),
        ("depth_scale", 1.0, 1000.0),
        ("depthShift", 1000, 1000.0),
        ("depth_unit_scale_factor", 0.0001, 10_000.0),
        ("integer_depth_scale", 0.0002, 5000.0),
        ("png_depth_scale", 6553.5, 6553.5),
        ("DepthMapFactor", 1.0, 1.0),
    ],
)
def test_the_unit_is_what_the_program_that_wrote_it_means(
    tmp_path: Path, field: str, value: float, per_metre: float
) -> None:
    for table in ({field: value}, {"cam": {field: value}}):
        unit = read_depth_unit(written(tmp_path, "config.json", table))
        assert unit is not None and unit.units_per_meter == pytest.approx(per_metre, rel=1e-9)
        assert "config.json" in unit.reason and field in unit.reason


def test_scannets_description_of_a_scene_holds_both_cameras(tmp_path: Path) -> None:
    found = read_camera_file(written(tmp_path, "scene0000_00.txt", SCANNET))
    calibration = found.calibration()
    depth, color = calibration.depth, calibration.color
    assert (depth.width, depth.fx, depth.cy) == (640, 577.87, 239.5)
    assert (color.width, color.fy, color.cx) == (1296, 1170.18, 647.75)
    np.testing.assert_allclose(calibration.color_from_depth[:3, 3], [-0.025, 0, 0])
    assert found.depth_unit is not None and found.depth_unit.units_per_meter == 1000.0


def test_the_description_of_a_sens_file_holds_both_cameras_and_the_unit(tmp_path: Path) -> None:
    apart = SENS + "m_calibrationDepthExtrinsic = 1 0 0 -0.025 0 1 0 0 0 0 1 0 0 0 0 1\n"
    found = read_camera_file(written(tmp_path, "info.txt", apart))
    depth, color = found.calibration().depth, found.calibration().color
    assert (depth.width, depth.fx, depth.cy) == (640, 577.87, 239.5)
    assert (color.width, color.fy, color.cx) == (1296, 1170.18, 647.75)
    np.testing.assert_allclose(found.color_from_depth[:3, 3], [-0.025, 0, 0])
    assert found.depth_unit is not None and found.depth_unit.units_per_meter == 4000.0


@pytest.mark.parametrize("field", ["colorToDepthExtrinsics", "m_calibrationColorExtrinsic"])
def test_a_transform_that_is_none_is_named(tmp_path: Path, field: str) -> None:
    text = re.sub(f"(?m)^{field} = .*$", "", SCANNET if field.startswith("color") else SENS)
    for numbers, what in (("0 " * 16, "a rigid transform"), ("- " * 16, "a finite number")):
        with pytest.raises(CalibrationError, match=rf"info\.txt: {field}: expected {what}"):
            read_camera_file(written(tmp_path, "info.txt", text + f"{field} = {numbers}\n"))


@pytest.mark.parametrize(
    "text",
    [
        "525 526 319.5 239.5\n",
        "525 0 319.5 0 526 239.5 0 0 1\n",
        "525 0 319.5 0\n0 526 239.5 0\n0 0 1 0\n0 0 0 1\n",
        "525,0,319.5\n0,526,239.5\n0,0,1\n",
        "[[525. 0. 319.5]\n [0. 526. 239.5]\n [0. 0. 1.]]\n",
        # By columns.
        "525 0 0\n0 526 0\n319.5 239.5 1\n",
        "fx = 525\nfy = 526\ncx = 319.5\ncy = 239.5\n",
        "[intrinsics]\nfx: 525\nfy: 526\ncx: 319.5\ncy: 239.5\nwidth: 640\nheight: 480\n",
        "[ 640x480  p[319.5 239.5]  f[525 526]  Inverse Brown Conrady [0 0 0 0 0] ]\n",
        RS_ENUMERATE.format("Inverse Brown Conrady", "0  \t0  \t0  \t0  \t0"),
        # COLMAP's first pixel is at a half.
        "# Camera list\n1 PINHOLE 640 480 525 526 320 240\n",
    ],
)
def test_a_camera_in_text_is_read(tmp_path: Path, text: str) -> None:
    assert values(written(tmp_path, "intrinsics.txt", text)) == [525, 526, 319.5, 239.5]


def test_an_azure_kinects_printed_calibration_is_read(tmp_path: Path) -> None:
    text = (
        "===== Device 0: 000123 =====\nresolution width: 640\nresolution height: 576\n"
        "principal point x: 321.2\nprincipal point y: 337.5\nfocal length x: 504.1\nfocal length y: 504.2\n"
        "radial distortion coefficients:\nk1: 0.6\nk2: 0.2\nk3: 0.01\nk4: 0.9\nk5: 0.3\nk6: 0.05\n"
        "center of distortion in Z=1 plane, x: {center}\ncenter of distortion in Z=1 plane, y: 0.000000\n"
        "tangential distortion coefficient x: 0.0001\ntangential distortion coefficient y: -0.0002\n"
        "metric radius: 1.74\n"
    )
    camera = read_camera_file(written(tmp_path, "a.txt", text.format(center=0))).calibration().depth
    assert (camera.width, camera.height, camera.fx, camera.cy) == (640, 576, 504.1, 337.5)
    # OpenCV's order: k1, k2, p1, p2, k3 to k6.
    assert camera.distortion.tolist() == [0.6, 0.2, 0.0001, -0.0002, 0.01, 0.9, 0.3, 0.05]
    with pytest.raises(CalibrationError, match="center of distortion"):
        read_camera_file(written(tmp_path, "a.txt", text.format(center=0.1)))


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("OPENCV 640 480 525 526 320 240 0.1 0.2 0.3 0.4", [0.1, 0.2, 0.3, 0.4]),
        ("RADIAL 640 480 525 320 240 0.1 0.2", [0.1, 0.2, 0.0, 0.0]),
        ("SIMPLE_PINHOLE 640 480 525 320 240", []),
    ],
)
def test_colmaps_models_that_are_opencvs_are_read(
    tmp_path: Path, model: str, distortion: list[float]
) -> None:
    camera = read_camera_file(written(tmp_path, "cameras.txt", f"1 {model}\n")).calibration().depth
    assert (camera.fx, camera.cx, camera.cy) == (525, 319.5, 239.5)
    assert camera.distortion.tolist() == distortion


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 FOV 640 480 525 526 320 240 0.9\n", "expected one of SIMPLE_PINHOLE"),
        ("1 PINHOLE 640 480 1 1 1 1\n2 PINHOLE 640 480 1 1 1 1\n", "has 2 cameras"),
        ("Width: 640\nFx: 600\nWidth: 848\nFx: 420\n", "Width: has two values"),
        ("525 0 319.5 7\n0 526 239.5 0\n0 0 1 0\n0 0 0 1\n", "expected a last column of 0"),
        ("1 2 3 4 5\n", "expected 3 rows of 3 numbers, or fx fy cx cy"),
        ("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n", "git lfs pull"),
        ("<!DOCTYPE html><html></html>", "an HTML page"),
    ],
)
def test_text_that_is_no_camera_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        read_camera_file(written(tmp_path, "a.txt", text))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.toml", "registered = true\r\n[color]\r\nfx = 525\r\nfy = 526\r\ncx = 319.5\r\ncy = 239.5\r\n"),
        ("a.txt", "525 0 319.5\r\n0 526 239.5\r\n0 0 1\r\n"),
        ("a.json", '{"fx": 525,\r\n"fy": 526, "cx": 319.5, "cy": 239.5}'),
        ("a.yaml", "k: [525, 0, 319.5, 0, 526, 239.5, 0, 0, 1]\r\n"),
        ("a.yml", "%YAML:1.0\r\n---\r\nCamera: {fx: 525, fy: 526, cx: 319.5, cy: 239.5}\r\n"),
    ],
)
def test_a_byte_order_mark_and_the_line_ends_of_windows_change_nothing(
    tmp_path: Path, name: str, text: str, encoding: str
) -> None:
    (tmp_path / name).write_bytes(text.encode(encoding))
    assert values(tmp_path / name) == [525, 526, 319.5, 239.5]


def test_a_principal_point_that_is_not_in_the_image_is_that_of_other_images(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # ScanNet's color camera, whose images were made as small as those of depth.
    path = written(tmp_path, "intrinsic.txt", "1170 0 647.7\n0 1170 483.7\n0 0 1\n")
    with pytest.raises(CalibrationError, match=r"\(647\.7, 483\.7\) is outside the images of 640x480"):
        read_camera_file(path).calibration(**SIZE)
    # It is the color camera's, where the color images are as large.
    found = read_camera_file(path).calibration(depth_size=(640, 480), color_size=(1280, 960))
    assert (found.color.fx, found.depth.fx) == (1170.0, 585.0)
    assert caplog.text == ""
    path = written(tmp_path, "intrinsic.txt", "585 0 500\n0 585 239.5\n0 0 1\n")
    read_camera_file(path).calibration(**SIZE)
    assert "far from the middle" in caplog.text
