"""The programs in docs/calibration.md, run on pictures of a chessboard by cameras that are known."""

import re
import runpy
from pathlib import Path

import cv2
import numpy as np
import pytest

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.drivers.calibration.file import read_camera_file
from nurbseg.drivers.mcap.writer import RecordingWriter

GUIDE = Path(__file__).parents[2] / "docs/calibration.md"
INFRARED = Intrinsics(640, 480, 580.0, 582.0, 325.0, 236.0, np.array([-0.08, 0.1, 0.001, -0.001]))
COLOR = Intrinsics(640, 480, 528.0, 526.0, 314.0, 247.0, np.array([0.05, -0.1, -0.001, 0.001]))
TURN = np.array([0.004, -0.006, 0.002])
SHIFT_M = np.array([-0.0251, 0.0004, 0.0006])
SQUARE_M = 0.025


def board_image():
    """A chessboard of 10 x 7 squares, 40 pixels each, with a white border of one square."""
    squares = np.indices((7, 10)).sum(axis=0) % 2 * 255
    image = np.kron(squares, np.ones((40, 40))).astype(np.uint8)
    return np.pad(image, 40, constant_values=255)


def picture(camera, rotation, translation_m):
    """What a camera sees of the board at this place, by the same lens model as OpenCV's."""
    grid = np.indices((camera.height, camera.width))[::-1].reshape(2, -1).T.astype(np.float64)
    straight = cv2.undistortPoints(grid.reshape(-1, 1, 2), camera.matrix, camera.distortion).reshape(-1, 2)
    rays = np.column_stack([straight, np.ones(len(straight))])
    # The board's plane is z = 0 in its own frame: rays meet it at t.
    normal = rotation[:, 2]
    t = (normal @ translation_m) / (rays @ normal)
    on_board = (rays * t[:, None] - translation_m) @ rotation
    pixels = (on_board[:, :2] / SQUARE_M * 40 + 80 - 0.5).astype(np.float32)
    shape = (camera.height, camera.width)
    blurred = cv2.GaussianBlur(board_image(), (0, 0), 1.0)
    return cv2.remap(
        blurred, pixels[:, 0].reshape(shape), pixels[:, 1].reshape(shape), cv2.INTER_LINEAR, borderValue=128
    )


def poses():
    """Twelve places of the board: center, sides and corners, tilted each its own way."""
    rng = np.random.default_rng(4)
    for number in range(12):
        rotation = cv2.Rodrigues(rng.uniform([-0.5, -0.5, -0.2], [0.5, 0.5, 0.2]))[0]
        aim = np.array([0.10 * (number % 4 - 1.5), 0.07 * (number // 4 - 1), 0.5 + 0.04 * (number % 3)])
        yield rotation, aim - rotation @ np.array([4.0 * SQUARE_M, 2.5 * SQUARE_M, 0.0])


def run(marker, folder, monkeypatch):
    """Run the program that follows a marker in the guide."""
    (program,) = re.findall(
        rf"<!-- run by the tests: {marker} -->\n```python\n(.*?)```", GUIDE.read_text(), re.DOTALL
    )
    (folder / "program.py").write_text(program)
    monkeypatch.chdir(folder)
    return runpy.run_path(str(folder / "program.py"))


def assert_like(found, true):
    assert (found.fx, found.fy) == pytest.approx((true.fx, true.fy), rel=0.01)
    assert (found.cx, found.cy) == pytest.approx((true.cx, true.cy), abs=4.0)


def test_the_color_camera_is_found_from_a_recording_of_a_chessboard(tmp_path, monkeypatch):
    nominal = Calibration.registered(Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5))
    with RecordingWriter(tmp_path / "board.mcap", nominal, color_format="png") as writer:
        for number, pose in enumerate(poses()):
            gray = picture(COLOR, *pose)
            # One view in thirty is taken.
            for repeated in range(30 if number < 11 else 1):
                writer.write(
                    RGBDFrame(
                        index=writer.frames,
                        timestamp_ns=(30 * number + repeated) * 33_333_333,
                        depth_mm=np.full((480, 640), 600, np.uint16),
                        color=cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB),
                        calibration=nominal,
                    )
                )
    outcome = run("color", tmp_path, monkeypatch)
    assert len(outcome["views"]) >= 10
    assert outcome["error_px"] < 0.5
    calibration = read_camera_file(tmp_path / "camera.toml").calibration()
    assert calibration.is_registered
    assert_like(calibration.color, COLOR)


def test_both_cameras_and_their_places_are_found_from_pairs_of_images(tmp_path, monkeypatch):
    folder = tmp_path / "board"
    folder.mkdir()
    turn = cv2.Rodrigues(TURN)[0]
    for number, (rotation, translation_m) in enumerate(poses()):
        cv2.imwrite(str(folder / f"{number:02d}_ir.png"), picture(INFRARED, rotation, translation_m))
        seen = picture(COLOR, turn @ rotation, turn @ translation_m + SHIFT_M)
        cv2.imwrite(str(folder / f"{number:02d}_color.png"), seen)
    outcome = run("stereo", tmp_path, monkeypatch)
    assert len(outcome["pairs"]) >= 10
    assert outcome["error_px"] < 0.5
    calibration = read_camera_file(tmp_path / "camera.yml").calibration()
    assert not calibration.is_registered
    assert_like(calibration.depth, INFRARED)
    assert_like(calibration.color, COLOR)
    assert calibration.color_from_depth[:3, 3] == pytest.approx(SHIFT_M, abs=0.003)
    assert calibration.color_from_depth[:3, :3] == pytest.approx(turn, abs=0.01)


def test_the_toml_in_the_guide_can_be_read(tmp_path):
    (text,) = re.findall(r"```toml\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    (tmp_path / "camera.toml").write_text(text)
    calibration = read_camera_file(tmp_path / "camera.toml").calibration()
    assert (calibration.depth.fx, calibration.color.fx) == (570.3, 525.0)
    assert not calibration.is_registered
