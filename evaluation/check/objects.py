"""Checks objects and their boxes against the tree, the images, the surfaces and the recording."""

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.export.objects import CONVENTION
from nurbseg.common.computer import one_blas_thread
from nurbseg.common.frame import Intrinsics
from nurbseg.evaluation.check.exported import ExportedFrame, MeasuredBox, MeasuredCamera, MeasuredObject
from nurbseg.evaluation.check.surfaces import derivatives, malformed
from nurbseg.library.boxes.borders import CLEAR_MIN, ENDS, MIXED, MIXED_AT_ENDS, MIXED_SHARE_MAX
from nurbseg.library.boxes.boxes import INWARD, INWARD_SHARE, POINTS
from nurbseg.library.boxes.completion import LONGER_MAX
from nurbseg.library.boxes.footprints import STRAY_SHARE
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
        check_visible(frame, name, each, cloud)
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
    if not frame.settings.temporal:
        _check_whole(frame, name, each)


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


def _check_whole(frame: ExportedFrame, name: str, each: MeasuredObject) -> None:
    """Check that the box of a frame alone is what is seen of it, made longer at most."""
    axes, whole = np.array(each.visible.axes), np.array(each.box.axes)
    (low, high), (seen_low, seen_high) = (_ends(box, axes) for box in (each.box, each.visible))
    if abs(high[2] - seen_high[2]) > _OFF or low[2] > seen_low[2] + _OFF:
        frame.wrong(name, "box", "the top of the visible one, and no less below", each.box, _FILE)
        return
    if np.abs(whole - axes).max() <= 4 * _HALF:
        if max(np.abs(low - seen_low)[:2].max(), np.abs(high - seen_high)[:2].max()) > _OFF:
            frame.wrong(name, "box", "the sides of the visible one, which has the same axes", each.box, _FILE)
        return
    # What is seen was turned by half a turn and added; along other axes other points are strays.
    seen = np.array(each.visible.size_m[:2])
    middle, reach = axes @ each.box.center_m, np.abs(axes @ whole.T) @ np.array(each.box.size_m) / 2.0
    missing = np.maximum(middle - reach - seen_low, seen_high - middle - reach)[:2]
    if (missing > INWARD_SHARE * seen + _OFF).any():
        frame.wrong(name, "box", "no less than what is visible", each.box, _FILE)
    elif max(each.box.size_m[:2]) > (1 + LONGER_MAX) * np.linalg.norm(seen) + _OFF:
        frame.wrong(name, "box", f"sides longer by {LONGER_MAX:g} at most", each.box.size_m, _FILE)


def _ends(box: MeasuredBox, axes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    middle, half = axes @ box.center_m, np.array(box.size_m) / 2.0
    return middle - half, middle + half


def check_visible(frame: ExportedFrame, name: str, each: MeasuredObject, cloud: PointMap) -> None:
    """Measure the visible box again along its axes, and that no rectangle around it is smaller."""
    leaves = [frame.segments[leaf] for leaf in each.leaves if leaf in frame.segments]
    pixels = [np.flatnonzero(frame.leaf_image == leaf.leaf) for leaf in leaves if leaf.leaf]
    count = sum(own.size for own in pixels)
    if not count or len(each.visible.axes) != 3:
        return
    step, noise = -(-count // POINTS), frame.settings.config.extended.inverse_depth_noise
    chosen = np.concatenate([_outline(own, cloud, noise, step) for own in pixels])
    axes = np.array(each.visible.axes)
    points_m = cloud.points_m.reshape(-1, 3)[chosen].astype(np.float64)
    places = axes @ points_m.T
    heights = np.sort(places[2])
    strays = int(STRAY_SHARE * heights.size)
    places = places[:2, _inner(places, strays)]
    middle = points_m.mean(axis=0)
    seen_low = np.append(places.min(axis=1), heights[strays])
    seen_high = np.append(places.max(axis=1), heights[-1 - strays])
    inward = np.minimum(
        INWARD * np.abs(axes @ middle) * noise * middle[2], INWARD_SHARE * (seen_high - seen_low)
    )
    inward = inward if strays else np.zeros(3)
    low, high = _ends(each.visible, axes)
    for end, expected in ((low, seen_low + inward), (high, seen_high - inward)):
        if np.abs(end - expected).max() > _OFF:
            frame.wrong(name, "visible", f"its ends along its axes {expected.round(6).tolist()}", end, _FILE)
            return
    (_, (one, other), _) = cv2.minAreaRect(places.T.astype(np.float32))
    area = float(np.prod((seen_high - seen_low)[:2]))
    if area > one * other * (1 + _LEAST_SHARE) + _LEAST_M2:
        frame.wrong(name, "visible", f"a rectangle of {one * other:.6f} square meters", area, _FILE)


def _outline(pixels: NDArray[np.intp], cloud: PointMap, noise: float, step: int) -> NDArray[np.intp]:
    """Return pixels at equal steps, and ends of runs; those beside nearer ones only if they are many."""
    # 0, no depth, is the farthest.
    inverse = np.where(cloud.valid, 1.0 / np.where(cloud.valid, cloud.points_m[..., 2], 1.0), 0.0)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    nearer = (cv2.dilate(inverse, cross, borderType=cv2.BORDER_REPLICATE) - inverse).reshape(-1)
    some = pixels[::step]
    clear, at_ends = some[nearer[some] <= MIXED * noise], MIXED_AT_ENDS * noise
    if clear.size < (1.0 - MIXED_SHARE_MAX) * some.size:
        clear, at_ends = some, np.inf
    follows = (np.diff(pixels) == 1) & (pixels[1:] % cloud.valid.shape[1] > 0)
    runs = np.split(pixels, np.flatnonzero(~follows) + 1)
    ends = [run[:: 1 - 2 * side] for run in runs for side in range(2)][:: (2 * len(runs) // ENDS) | 1]
    found = [clear]
    for run in ends:
        is_clear = nearer[run] <= at_ends
        many = min(CLEAR_MIN, run.size)
        first = np.flatnonzero(np.lib.stride_tricks.sliding_window_view(is_clear, many).all(axis=1))
        found.append(run[first[:1]])
    return np.concatenate(found)


def _inner(places: NDArray[np.float64], strays: int) -> NDArray[np.bool_]:
    """Leave out strays: the outermost of points, (3, N), upwards and along both axes of the footprint."""
    flat = places[:2] - places[:2].mean(axis=1, keepdims=True)
    along = np.linalg.eigh(flat @ flat.T)[1].T @ flat
    inner = np.ones(places.shape[1], dtype=np.bool_)
    for values in (places[2], *along):
        ordered = np.sort(values)
        inner &= (values >= ordered[strays]) & (values <= ordered[-1 - strays])
    return inner
