"""Checks objects and their boxes against the tree, the images, the surfaces and the recording."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.export.objects import CONVENTION
from nurbseg.common.computer import one_blas_thread
from nurbseg.common.frame import Intrinsics
from nurbseg.evaluation.check.exported import ExportedFrame, MeasuredCamera, MeasuredObject
from nurbseg.evaluation.check.surfaces import derivatives, malformed
from nurbseg.segmentation.points.registration import PointMap

_FILE = "objects.json"
#: Half of the last digit of meters and directions, of colors and of residuals, and a rounding.
_HALF, _HALF_COLOR, _HALF_RMS = 0.6e-6, 0.6e-2, 1e-7
#: Residuals of at most this size count as 0 in the tree.
_ROUNDING_M = 1e-6
#: Normals of a surface that are averaged at most.
_NORMALS = 100


def check_objects(frame: ExportedFrame) -> None:
    """Check what the rest of the export says of the objects; only if they were exported."""
    found, tree = frame.objects_file, frame.tree
    if found is None:
        return
    for field, expected in (
        ("frame", tree.frame),
        ("name", tree.name),
        ("timestamp_ns", tree.timestamp_ns),
        ("coordinates", CONVENTION),
        ("level", "objects" if frame.objects else "surfaces"),
    ):
        _compare(frame, "", field, expected, getattr(found, field))
    _compare(frame, "camera", "size", frame.shape[::-1], (found.camera.width, found.camera.height))
    image = frame.images["objects" if frame.objects else "labels"]
    counts = dict(
        zip(*(each.tolist() for each in np.unique(image[image > 0], return_counts=True)), strict=True)
    )
    _compare(frame, "", "objects", list(counts), [each.object for each in found.objects])
    for each in found.objects:
        name = f"object {each.object}"
        _compare(frame, name, "pixels", counts.get(each.object), each.pixels)
        leaves = tuple(
            leaf.name for leaf in frame.leaves if each.object == (leaf.object if frame.objects else leaf.leaf)
        )
        _compare(frame, name, "leaves", leaves, each.leaves)
        is_pending = any(frame.segments[leaf].stop == "pending" for leaf in leaves)
        _compare(frame, name, "pending", is_pending, each.pending)
        _check_rms(frame, name, each)
        _check_directions(frame, name, each)
        if not all(0 <= part <= 255 for part in each.color) or len(each.color) != 3:
            frame.wrong(name, "color", "three numbers from 0 to 255", each.color, _FILE)


def _compare(frame: ExportedFrame, name: str, field: str, expected: object, found: object) -> None:
    if found != expected:
        frame.wrong(name, field, str(expected), found, _FILE)


def _check_rms(frame: ExportedFrame, name: str, each: MeasuredObject) -> None:
    """Check the residual of an object, which is the mean of the squares of all its leaves."""
    leaves = [frame.segments[leaf] for leaf in each.leaves if leaf in frame.segments]
    fitted = [leaf for leaf in leaves if leaf.surface and leaf.points and leaf.values.get("mse") is not None]
    if not fitted:
        _compare(frame, name, "rms_m", None, each.rms_m)
        return
    squares = sum((leaf.values["mse"] or 0.0) * leaf.points for leaf in fitted)
    rms_m = float(np.sqrt(squares / sum(leaf.points for leaf in fitted)))
    off_m = _HALF_RMS + (_ROUNDING_M if any(not leaf.values["mse"] for leaf in fitted) else 0.0)
    if each.rms_m is None or not abs(each.rms_m - rms_m) <= off_m:
        frame.wrong(name, "rms_m", f"{rms_m:.7f}, that of the values of its leaves", each.rms_m, _FILE)


def _check_directions(frame: ExportedFrame, name: str, each: MeasuredObject) -> None:
    """Check the form of the boxes, and that the normal is that of the surfaces."""
    if len(each.centroid_m) != 3:
        frame.wrong(name, "centroid_m", "three numbers", each.centroid_m, _FILE)
        return
    check_boxes(frame, name, each)
    if not frame.settings.surfaces:
        if each.normal is not None and abs(np.linalg.norm(each.normal) - 1.0) > 4 * _HALF:
            frame.wrong(name, "normal", "a unit vector", each.normal, _FILE)
        return
    expected = _mean_normal(frame, each)
    unlike = (expected is None) != (each.normal is None)
    if expected is not None and each.normal is not None:
        unlike = len(each.normal) != 3 or float(np.abs(expected - each.normal).max()) > 2 * _HALF
    if unlike:
        wanted = None if expected is None else expected.round(6).tolist()
        frame.wrong(name, "normal", f"{wanted}, that of its surfaces", each.normal, _FILE)


def _mean_normal(frame: ExportedFrame, each: MeasuredObject) -> NDArray[np.float64] | None:
    """Return the mean of the normals at pixels of its leaves, weighted by size, toward the camera."""
    total = np.zeros(3)
    for leaf in (frame.segments[name] for name in each.leaves if name in frame.segments):
        surface = frame.surfaces.get(leaf.name)
        pixels = np.flatnonzero(frame.leaf_image == leaf.leaf) if leaf.leaf else np.zeros(0, np.int64)
        if surface is None or malformed(surface) or not pixels.size:
            continue
        chosen = pixels[:: -(-pixels.size // _NORMALS)]
        S = derivatives(surface, *np.divmod(chosen, frame.shape[1]), order=2)
        normal = np.cross(S[1, 0], S[0, 1])
        length = np.linalg.norm(normal, axis=1)
        normal = normal[length > 0] / length[length > 0, np.newaxis]
        total -= normal.sum(axis=0) * (pixels.size / chosen.size)
    length = float(np.linalg.norm(total))
    return total / length if length > 0 else None


@one_blas_thread()
def check_object_points(frame: ExportedFrame, cloud: PointMap, camera: Intrinsics) -> None:
    """Check the camera, and measure the points of each object again.

    `cloud` holds the points of the same frame.
    """
    found = frame.objects_file
    if found is None or frame.leaf_image.shape != cloud.valid.shape:
        return
    sizes = camera.width, camera.height
    recorded = MeasuredCamera(
        *sizes, camera.fx, camera.fy, camera.cx, camera.cy, tuple(camera.distortion.tolist())
    )
    _compare(frame, "", "camera", recorded, found.camera)
    image = frame.images["objects" if frame.objects else "labels"]
    for each in found.objects:
        own = (image == each.object) & cloud.valid
        if not own.any():
            continue
        points_m, name = cloud.points_m[own], f"object {each.object}"
        for field, expected, value, off in (
            ("centroid_m", points_m.astype(np.float64).mean(axis=0), each.centroid_m, _HALF),
            ("color", cloud.color[own].astype(np.float64).mean(axis=0), each.color, _HALF_COLOR),
        ):
            if len(value) != expected.size or float(np.abs(expected - value).max()) > off:
                frame.wrong(name, field, f"{expected.round(6).tolist()}, of its points", value, _FILE)


#: How far what follows from several rounded meters and directions may be off.
_OFF = 1e-5
#: A rectangle may be larger than the least by so much, as a share and in square meters.
_LEAST_SHARE, _LEAST_M2 = 1e-3, 1e-6


def check_boxes(frame: ExportedFrame, name: str, each: MeasuredObject) -> None:
    """Check that axes are at right angles, upright on the support, and that both boxes and the pose agree."""
    for field, box in (("box", each.box), ("visible", each.visible)):
        vectors = (box.center_m, box.size_m, *box.axes)
        if len(box.axes) != 3 or any(len(vector) != 3 for vector in vectors):
            frame.wrong(name, field, "three axes, and three numbers in each vector", box, _FILE)
            return
        axes = np.array(box.axes)
        if np.abs(axes @ axes.T - np.eye(3)).max() > 4 * _HALF or np.linalg.det(axes) < 0:
            frame.wrong(
                name, f"{field}: axes", "right-handed unit vectors at right angles", axes.tolist(), _FILE
            )
            return
        if min(box.size_m) < 0:
            frame.wrong(name, f"{field}: size_m", "no negative one", box.size_m, _FILE)
        support = frame.objects_file.support if frame.objects_file is not None else None
        if support is not None and np.abs(axes[2] - support.normal).max() > 4 * _HALF:
            frame.wrong(name, f"{field}: axes", f"the last one {support.normal}", box.axes[2], _FILE)
    if not each.visible.size_m[0] >= each.visible.size_m[1] - _HALF:
        frame.wrong(name, "visible: size_m", "the first no less than the second", each.visible.size_m, _FILE)
    _check_pose(frame, name, each)


def _check_pose(frame: ExportedFrame, name: str, each: MeasuredObject) -> None:
    """Check the pose on the support: its height and its vertical follow from the support."""
    support = frame.objects_file.support if frame.objects_file is not None else None
    pose = each.support_from_object
    if (support is None) != (pose is None):
        frame.wrong(name, "support_from_object", "one if there is a support", pose, _FILE)
    if support is None or pose is None:
        return
    found = np.array(pose)
    height = float(np.dot(support.normal, each.box.center_m)) + support.camera_height_m
    expected = [0.0, 0.0, 1.0, height]
    if found.shape != (4, 4) or np.abs(found[2] - expected).max() > _OFF:
        frame.wrong(name, "support_from_object", f"its third row {expected}", pose, _FILE)
