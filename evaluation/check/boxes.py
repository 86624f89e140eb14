"""Checks the boxes of objects: their form, what of them is seen, and what they stand on."""

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.evaluation.check.exported import ExportedFrame, MeasuredBox, MeasuredObject
from nurbseg.library.boxes.borders import MIXED, MIXED_SHARE_MAX
from nurbseg.library.boxes.boxes import POINTS
from nurbseg.library.boxes.completion import LONGER_MAX
from nurbseg.library.boxes.footprints import STRAY_SHARE
from nurbseg.segmentation.points.registration import PointMap

_FILE = "objects.json"
#: Half of the last digit of meters and directions, and a rounding; of what follows from several of them.
_HALF, _OFF = 0.6e-6, 1e-5
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
    axes = np.array(each.visible.axes)
    (low, high), (seen_low, seen_high) = (_ends(box, axes) for box in (each.box, each.visible))
    if np.abs(np.array(each.box.axes) - axes).max() > 4 * _HALF or abs(high[2] - seen_high[2]) > _OFF:
        frame.wrong(name, "box", "the axes and the top of the visible one", each.box, _FILE)
    elif (low > seen_low + _OFF).any() or (high < seen_high - _OFF).any():
        frame.wrong(name, "box", "no less than what is visible", each.box, _FILE)
    elif (each.box.size_m[:2] > (1 + LONGER_MAX) * np.array(each.visible.size_m[:2]) + _OFF).any():
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
    step = -(-count // POINTS)
    chosen = np.concatenate([own[::step] for own in pixels])
    chosen = _without_mixed(chosen, cloud, frame.settings.config.extended.inverse_depth_noise)
    axes = np.array(each.visible.axes)
    places = axes @ cloud.points_m.reshape(-1, 3)[chosen].astype(np.float64).T
    heights = np.sort(places[2])
    strays = int(STRAY_SHARE * heights.size)
    places = places[:2, _inner(places, strays)]
    low, high = _ends(each.visible, axes)
    for end, expected in (
        (low, np.append(places.min(axis=1), heights[strays])),
        (high, np.append(places.max(axis=1), heights[-1 - strays])),
    ):
        if np.abs(end - expected).max() > _OFF:
            frame.wrong(name, "visible", f"its ends along its axes {expected.round(6).tolist()}", end, _FILE)
            return
    (_, (one, other), _) = cv2.minAreaRect(places.T.astype(np.float32))
    area = each.visible.size_m[0] * each.visible.size_m[1]
    if area > one * other * (1 + _LEAST_SHARE) + _LEAST_M2:
        frame.wrong(name, "visible", f"a rectangle of {one * other:.6f} square meters", area, _FILE)


def _without_mixed(pixels: NDArray[np.intp], cloud: PointMap, noise: float) -> NDArray[np.intp]:
    """Leave out pixels beside clearly nearer ones, unless they are many."""
    # 0, no depth, is the farthest.
    inverse = np.where(cloud.valid, 1.0 / np.where(cloud.valid, cloud.points_m[..., 2], 1.0), 0.0)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    nearer = cv2.dilate(inverse, cross, borderType=cv2.BORDER_REPLICATE) - inverse > MIXED * noise
    kept = pixels[~nearer.reshape(-1)[pixels]]
    return kept if kept.size >= (1.0 - MIXED_SHARE_MAX) * pixels.size else pixels


def _inner(places: NDArray[np.float64], strays: int) -> NDArray[np.bool_]:
    """Leave out strays: the outermost of points, (3, N), upwards and along both axes of the footprint."""
    flat = places[:2] - places[:2].mean(axis=1, keepdims=True)
    along = np.linalg.eigh(flat @ flat.T)[1].T @ flat
    inner = np.ones(places.shape[1], dtype=np.bool_)
    for values in (places[2], *along):
        ordered = np.sort(values)
        inner &= (values >= ordered[strays]) & (values <= ordered[-1 - strays])
    return inner
