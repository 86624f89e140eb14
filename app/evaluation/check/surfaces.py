"""Checks surfaces and the pixels they were fitted to, and evaluates surfaces with SciPy."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.ndimage import find_objects

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedSurface, Finding


def check_measured(frame: ExportedFrame) -> Iterator[Finding]:
    """Check the measured pixels against each other, the grid and the number of points."""
    file = frame.surfaces_file
    if set(frame.measured) != set(frame.segments):
        yield Finding(file, "", "measured", f"{sorted(frame.segments)}", f"{sorted(frame.measured)}")
        return
    valid, step = frame.leaf_image > 0, frame.step
    on_grid = np.zeros_like(valid)
    on_grid[::step, ::step] = valid[::step, ::step]
    for name, each in frame.segments.items():
        pixels = frame.measured[name]
        if pixels.size != each.points:
            yield Finding(file, name, "measured", f"{each.points} pixels", str(pixels.size))
        # Values from another frame have its pixels; a segment that a live tree did not cut has none.
        own = each.measured == frame.tree.frame and (pixels.size or each.points)
        if each.children and own and not np.array_equal(pixels, _measured_below(frame, name)):
            yield Finding(file, name, "measured", "the pixels of its leaves", "others")
    if not np.array_equal(_measured_below(frame, "P"), np.flatnonzero(on_grid)):
        expected = f"in all leaves the pixels with a label of every {step} rows and columns"
        yield Finding(file, "P", "measured", expected, "others")


def _measured_below(frame: ExportedFrame, name: str) -> NDArray[np.int64]:
    """Return the measured pixels of all leaves below a segment, in order."""
    return np.sort(np.concatenate([frame.measured[leaf.name] for leaf in frame.below(name)]))


def check_surfaces(frame: ExportedFrame) -> Iterator[Finding]:
    """Check the surfaces' arrays against each other, and their windows against the pixels."""
    with_surface = [name for name, each in frame.segments.items() if each.surface]
    if list(frame.surfaces) != with_surface:
        yield Finding(frame.surfaces_file, "", "names", str(with_surface), str(list(frame.surfaces)))
    for name, each in frame.segments.items():
        if each.surface == bool(each.reason):
            yield frame.wrong(name, "reason", "one where there is no surface", repr(each.reason))
    boxes = _boxes(frame)
    for name, surface in frame.surfaces.items():
        if name not in frame.segments:
            continue
        wrong = malformed(surface)
        if wrong:
            yield Finding(frame.surfaces_file, name, *wrong)
        rows, columns = np.divmod(frame.measured.get(name, np.zeros(0, dtype=np.int64)), frame.shape[1])
        corners = [boxes[name]] if name in boxes else []
        if rows.size:
            corners.append((rows.min(), columns.min(), rows.max() + 1, columns.max() + 1))
        top, left, bottom, right = surface.window
        for box in corners:
            if not (top <= box[0] and left <= box[1] and box[2] <= bottom and box[3] <= right):
                whole = f"to hold all pixels, {tuple(int(each) for each in box)}"
                yield Finding(frame.surfaces_file, name, "window", whole, str(surface.window))
                break
        if not (0 <= top < bottom <= frame.shape[0] and 0 <= left < right <= frame.shape[1]):
            image = f"part of the image {frame.shape}"
            yield Finding(frame.surfaces_file, name, "window", image, str(surface.window))


def _boxes(frame: ExportedFrame) -> dict[str, tuple[int, int, int, int]]:
    """Return the bounding box of each segment's pixels: first row and column, one past the last of each."""
    leaf_of = {leaf.leaf: leaf.name for leaf in frame.leaves() if leaf.leaf}
    boxes: dict[str, tuple[int, int, int, int]] = {}
    for label, found in enumerate(find_objects(frame.leaf_image), start=1):
        name = leaf_of.get(label, "") if found is not None else ""
        for end in range(1, len(name) + 1):
            box, (rows, columns) = boxes.get(name[:end], (*frame.shape, 0, 0)), found
            first = min(box[0], rows.start), min(box[1], columns.start)
            boxes[name[:end]] = (*first, max(box[2], rows.stop), max(box[3], columns.stop))
    return boxes


def malformed(surface: ExportedSurface) -> tuple[str, str, str] | None:
    """Return what is wrong with a surface's arrays: the field, what is expected, and what was found."""
    n, m = surface.weights.shape if surface.weights.ndim == 2 else (0, 0)
    if surface.control_points_m.shape != (n, m, 3):
        return "control_points_m", f"{(n, m, 3)} as weights", str(surface.control_points_m.shape)
    for axis, knots, count, degree in (
        ("knots_u", surface.knots_u, m, surface.degree[0]),
        ("knots_v", surface.knots_v, n, surface.degree[1]),
    ):
        if not 0 < degree < count or knots.shape != (count + degree + 1,):
            expected = f"{count + degree + 1} knots for {count} points of a degree from 1 to {count - 1}"
            return axis, expected, f"{knots.size}, degree {degree}"
        # NaN is not ascending.
        if not (np.diff(knots) >= 0).all() or not knots[degree] < knots[count] < np.inf:
            return axis, "numbers that ascend", "others"
    if not (np.isfinite(surface.control_points_m).all() and np.isfinite(surface.weights).all()):
        return "control_points_m", "finite numbers", "others"
    if not (surface.weights > 0).all():
        return "weights", "more than 0", str(float(surface.weights.min()))
    return None


def derivatives(
    surface: ExportedSurface, rows: NDArray[np.int64], columns: NDArray[np.int64], *, order: int
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Evaluate a surface and its partial derivatives at some pixels (eq. 4).

    Parameters
    ----------
    surface : ExportedSurface
        The surface; its parameters are u, the column, and v, the row.
    rows, columns : (N,) int64
        The pixels.
    order : int
        Up to which order, 0 or 2.

    Returns
    -------
    dict of (int, int) to (N, 3) float64
        By the order along u and v: metres, per pixel to the power of the order.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, eq. 4.20.
    """
    weights = surface.weights[..., np.newaxis]
    net = np.concatenate([surface.control_points_m * weights, weights], axis=-1)
    v, row = np.unique(rows, return_inverse=True)
    u, column = np.unique(columns, return_inverse=True)

    def homogeneous(du: int, dv: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        along_v = BSpline(surface.knots_v, net, surface.degree[1])(v, nu=dv)
        both = BSpline(surface.knots_u, along_v, surface.degree[0], axis=1)(u, nu=du)
        at = both[row, column]
        return at[:, :3], at[:, 3:]

    A, w = homogeneous(0, 0)
    S = {(0, 0): A / w}
    if order == 0:
        return S
    (Au, wu), (Av, wv) = homogeneous(1, 0), homogeneous(0, 1)
    S[1, 0], S[0, 1] = (Au - wu * S[0, 0]) / w, (Av - wv * S[0, 0]) / w
    for (du, dv), terms in (
        ((2, 0), 2.0 * wu * S[1, 0]),
        ((1, 1), wu * S[0, 1] + wv * S[1, 0]),
        ((0, 2), 2.0 * wv * S[0, 1]),
    ):
        A2, w2 = homogeneous(du, dv)
        S[du, dv] = (A2 - terms - w2 * S[0, 0]) / w
    return S
