"""What a program of one's own gets from `import nurbseg`."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import exported_names
import numpy as np
import pytest
from numpy.typing import NDArray

import nurbseg

ROOT = Path(__file__).parent.parent


def test_every_exported_name_is_what_it_is_declared_to_be() -> None:
    done = subprocess.run(
        [sys.executable, exported_names.__file__, "nurbseg"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert set(nurbseg.__all__) <= set(dir(nurbseg))
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        nurbseg.nothing_of_the_kind  # noqa: B018


def test_the_version_is_that_of_the_project() -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        assert nurbseg.__version__ == tomllib.load(file)["project"]["version"]


def test_importing_it_imports_nothing_else() -> None:
    program = (
        "import sys, nurbseg; sys.exit(any(n in sys.modules for n in ('numpy', 'cv2', 'importlib.metadata')))"
    )
    assert subprocess.run([sys.executable, "-c", program], timeout=60).returncode == 0


def a_frame(depth: NDArray[Any]) -> nurbseg.RGBDFrame:
    color = np.zeros((*depth.shape, 3), dtype=np.uint8)
    return nurbseg.RGBDFrame.from_arrays(depth, color, 500.0, 510.0, 1.5, 0.5)


def test_a_result_is_shown_in_a_line() -> None:
    depth = np.full((48, 64), 1000, dtype=np.uint16)
    depth[:, 32:] = 2000
    result = nurbseg.segment(a_frame(depth))
    assert str(result) == "FrameResult(frame 0, SegmentationTree(64x48, 2 surfaces, 2 objects))"
    root, *leaves = result.tree.segments
    assert str(root) == f"Segment('', {48 * 64} pixels, gap)"
    assert [str(leaf) for leaf in leaves] == [f"Segment('{n}', {48 * 32} pixels, noise)" for n in (0, 1)]


def test_frames_and_objects_are_shown_in_a_line() -> None:
    depth = np.full((40, 60), 2000, dtype=np.uint16)
    frame = a_frame(depth)
    assert repr(frame) == "RGBDFrame(0, 60x40, 0 ns)"
    assert repr(replace(frame, index=3, name="a", timestamp_ns=7)) == "RGBDFrame(3, 'a', 60x40, 7 ns)"
    (thing,) = nurbseg.segment(frame).objects
    # 1 % at either end of each axis does not count.
    assert re.fullmatch(
        r"MeasuredObject\(1, 2400 pixels, 0\.2[23]\d x 0\.15\d x 0\.000 m, 2\.00\d m away\)", repr(thing)
    )


def test_objects_of_a_frame_alone_are_measured_with_the_noise_that_is_set() -> None:
    depth = np.full((40, 60), 2000, dtype=np.uint16)
    config = nurbseg.SegmentationConfig()
    config = replace(config, extended=replace(config.extended, inverse_depth_noise=0.004))
    (alone,) = nurbseg.segment(a_frame(depth), config).objects
    (live,) = nurbseg.Segmenter(config).process(a_frame(depth)).objects
    # Noise of depth is that of inverse depth times the square of the distance.
    assert alone.noise_m == pytest.approx(0.004 * 2.0**2)
    assert alone.sigma == live.sigma


def test_points_surfaces_and_meshes_are_shown_in_a_line() -> None:
    depth = np.full((40, 60), 2000, dtype=np.uint16)
    depth[0, :7] = 0
    result = nurbseg.segment(a_frame(depth))
    assert repr(result.cloud) == f"PointMap(60x40, {40 * 60 - 7} points)"
    surface = result.tree.leaves()[0].fit.surface
    assert surface is not None
    rows, columns, _ = surface.control_points_m.shape
    shown = f"NurbsSurface(degree {surface.degree}, {columns}x{rows} control points, window (0, 0, 40, 60))"
    assert repr(surface) == shown
    mesh = result.objects[0].mesh()
    assert repr(mesh) == f"SurfaceMesh({len(mesh.vertices_m)} vertices, {len(mesh.triangles)} triangles)"


def test_objects_are_measured_once() -> None:
    result = nurbseg.segment(a_frame(np.full((40, 60), 2000, dtype=np.uint16)))
    assert result.objects is result.objects
    assert replace(result, elapsed_ms={}).objects is not result.objects


@pytest.mark.parametrize("level", ["object", "Objects", 1, ""])
def test_an_unknown_level_is_refused(level: Any) -> None:
    result = nurbseg.segment(a_frame(np.full((40, 60), 2000, dtype=np.uint16)))
    for labels in (result.labels, result.tree.labels):
        with pytest.raises(ValueError, match=f"level: expected surfaces or objects, got {level!r}"):
            labels(level)


def test_what_is_no_configuration_is_refused() -> None:
    frame = a_frame(np.full((40, 60), 2000, dtype=np.uint16))
    for call in (lambda: nurbseg.segment(frame, "stag15"), lambda: nurbseg.Segmenter("stag15")):  # type: ignore[arg-type]
        with pytest.raises(TypeError, match=r"config: expected .*, got 'stag15'"):
            call()


def test_an_array_in_place_of_a_frame_is_refused() -> None:
    depth: Any = np.full((40, 60), 2000, dtype=np.uint16)
    for call in (nurbseg.segment, nurbseg.Segmenter().process):
        with pytest.raises(TypeError, match=r"frame: expected an RGBDFrame, .*, got ndarray"):
            call(depth)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"depth_mm": [[2000] * 60] * 40}, r"depth_mm: expected \(H, W\) uint16, got list"),
        ({"color": None}, r"color: expected \(H, W, 3\) uint8, got NoneType"),
        ({"timestamp_ns": 1.5e9}, r"timestamp_ns: expected whole nanoseconds, got 1500000000\.0"),
    ],
)
def test_a_frame_of_something_else_than_arrays_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(a_frame(np.full((40, 60), 2000, dtype=np.uint16)), **values)


def test_a_result_survives_pickling_without_the_application() -> None:
    code = """
import pickle, sys
import numpy as np
import nurbseg
color = np.zeros((40, 60, 3), np.uint8)
frame = nurbseg.RGBDFrame.from_arrays(np.full((40, 60), 2000, np.uint16), color, 50.0, 50.0, 29.5, 19.5)
again = pickle.loads(pickle.dumps(nurbseg.segment(frame)))
print(len(again.objects), again.frame.depth_mm.max(), "nurbseg.app.live.parallel" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["1", "2000", "False"], done.stderr


def test_what_is_no_calibration_is_refused() -> None:
    with pytest.raises(TypeError, match=r"calibration: expected a Calibration or a Path, got 'a\.toml'"):
        nurbseg.SourceOptions(calibration="a.toml")  # type: ignore[arg-type]


@pytest.mark.parametrize("uri", [0, None, b"a"])
def test_what_is_no_path_is_refused(uri: Any) -> None:
    with pytest.raises(TypeError, match=r"uri: expected a path, or a camera such as 'openni2:', got "):
        nurbseg.open_source(uri)


def test_a_frame_of_arrays_holds_millimeters_of_whole_numbers_and_of_metres() -> None:
    whole = np.array([[0, 1, 1234], [65534, 40, 65535]], dtype=np.uint16)
    meters = np.array([[np.nan, 0.001, 1.2341], [65.534, 0.0396, -2.0]], dtype=np.float32)
    for depth in (whole, meters):
        frame = a_frame(depth)
        assert frame.depth_mm.tolist() == [[0, 1, 1234], [65534, 40, 0]]
        # A copy: what a camera's library fills anew stays writeable.
        assert depth.flags.writeable
    assert frame.calibration.is_registered
    camera = frame.calibration.depth
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (
        3,
        2,
        500,
        510,
        1.5,
        0.5,
    )
    assert not a_frame(np.array([[65.5356, np.inf, -np.inf]])).depth_mm.any()


@pytest.mark.parametrize(
    ("depth", "color", "message"),
    [
        (np.zeros((2, 3), np.int32), np.zeros((2, 3, 3), np.uint8), r"depth: expected uint16 .* got int32"),
        (
            np.zeros((2, 3), np.uint16),
            np.zeros((4, 6, 3), np.uint8),
            r"got \(2, 3\) and \(4, 6, 3\)",
        ),
        (np.zeros((2, 3), np.uint16), np.zeros((2, 3), np.uint8), r"color: expected \(H, W, 3\) uint8"),
        (np.zeros((2, 3, 1), np.uint16), np.zeros((2, 3, 3), np.uint8), r"expected \(H, W\) and"),
    ],
)
def test_arrays_that_are_no_frame_are_refused(depth: NDArray[Any], color: NDArray[Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        nurbseg.RGBDFrame.from_arrays(depth, color, 500.0, 500.0, 1.0, 1.0)


def test_millimeters_in_place_of_metres_are_warned_of() -> None:
    with pytest.warns(UserWarning, match="floats are meters, and millimeters must be uint16"):
        frame = a_frame(np.array([[0.0, 700.0, np.inf]]))
    assert not frame.depth_mm.any()
    a_frame(np.array([[0.0, np.inf, np.nan]]))
    a_frame(np.array([[0.0, 700.0, 7.0]]))
    a_frame(np.zeros((1, 3)))


_SCRIPT = """\
import numpy as np
from numpy.typing import NDArray

from nurbseg import RGBDFrame, SegmentationConfig, Segmenter, open_source, segment

depth: NDArray[np.uint16] = np.full((48, 64), 1000, dtype=np.uint16)
color: NDArray[np.uint8] = np.zeros((48, 64, 3), dtype=np.uint8)
frame = RGBDFrame.from_arrays(depth, color, 60.0, 60.0, 31.5, 23.5)
labels: NDArray[np.uint16] = segment(frame, SegmentationConfig(metric="mae")).labels("objects")
for each in Segmenter().process(frame).objects:
    size: NDArray[np.float64] = each.box.size_m
with open_source("demo.mcap") as source:
    stamps: list[int] = [frame.timestamp_ns for frame in source]
"""


def test_a_users_script_is_checked_by_mypy(tmp_path: Path) -> None:
    api = pytest.importorskip("mypy.api")
    script = tmp_path / "script.py"
    for source, faults in ((_SCRIPT, 0), (_SCRIPT.replace('metric="mae"', "metric=7"), 1)):
        script.write_text(source)
        told, _, code = api.run(["--strict", "--cache-dir", str(tmp_path / "cache"), str(script)])
        assert (code, told.count("error:")) == (faults, faults), told


@pytest.mark.parametrize("dtype", [">u2", "<u2", "<f2", ">f4", "<f8"])
def test_from_arrays_takes_any_layout_of_depth(dtype: str) -> None:
    depth_mm = np.arange(1000, 1012, dtype=np.uint16).reshape(3, 4) * 2
    values = depth_mm / 1000 if "f" in dtype else depth_mm
    depth = np.ma.masked_array(np.asfortranarray(values.astype(dtype)), mask=np.eye(3, 4, dtype=bool))
    color = np.zeros((4, 3, 3), np.uint8).transpose(1, 0, 2)
    frame = nurbseg.RGBDFrame.from_arrays(depth, color, 500.0, 500.0, 1.5, 1.0)
    expected = np.where(np.eye(3, 4), 0, depth_mm)
    np.testing.assert_allclose(frame.depth_mm.astype(int), expected, atol=1 if dtype == "<f2" else 0)
    assert frame.depth_mm.dtype == np.uint16
    assert frame.depth_mm.flags.c_contiguous and frame.color.flags.c_contiguous


def test_from_arrays_takes_65535_for_no_depth_and_refuses_what_is_none() -> None:
    color = np.zeros((1, 2, 3), np.uint8)
    frame = nurbseg.RGBDFrame.from_arrays(np.array([[65535, 7]], np.uint16), color, 9.0, 9.0, 0.0, 0.0)
    assert frame.depth_mm.tolist() == [[0, 7]]

    class OfAGpu:
        def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
            raise TypeError("can't convert cuda tensor")

    for depth, text in (
        (np.ones((1, 2), np.int32), r"got int32; .*depth\.astype\(np\.uint16\)"),
        (OfAGpu(), "depth: cannot be made a NumPy array .*cuda"),
    ):
        with pytest.raises(ValueError, match=text):
            nurbseg.RGBDFrame.from_arrays(depth, color, 9.0, 9.0, 0.0, 0.0)
