"""Checks surfaces and the pixels they were fitted to, and evaluates surfaces with SciPy."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.ndimage import find_objects

from nurbseg.evaluation.check.exported import ExportedFrame, ExportedSurface

#: Ending of the file that holds surfaces and measured pixels.
SURFACES = "surfaces.npz"


def check_measured(frame: ExportedFrame) -> None:
    """Check the measured pixels against each other, the grid and the number of points."""
    if set(frame.measured) != set(frame.segments):
        frame.wrong("", "measured", sorted(frame.segments), sorted(frame.measured), SURFACES)
        return
    valid, step = frame.leaf_image > 0, frame.step
    on_grid = np.zeros_like(valid)
    on_grid[::step, ::step] = valid[::step, ::step]
    for name, segment in frame.segments.items():
        pixels = frame.measured[name]
        if pixels.size != segment.points:
            frame.wrong(name, "measured", f"{segment.points} pixels", pixels.size, SURFACES)
        # Values from another frame have its pixels; a segment that a live tree did not cut has none.
        own = segment.measured == frame.tree.frame and (pixels.size or segment.points)
        if segment.children and own and not np.array_equal(pixels, _measured_below(frame, name)):
            frame.wrong(name, "measured", "the pixels of its leaves", "others", SURFACES)
    if not np.array_equal(_measured_below(frame, "P"), np.flatnonzero(on_grid)):
        expected = f"in all leaves the pixels with a label of every {step} rows and columns"
        frame.wrong("P", "measured", expected, "others", SURFACES)


def _measured_below(frame: ExportedFrame, name: str) -> NDArray[np.int64]:
    """Return the measured pixels of all leaves below a segment, in order."""
    return np.sort(np.concatenate([frame.measured[leaf.name] for leaf in frame.below(name)]))


def check_surfaces(frame: ExportedFrame) -> None:
    """Check the surfaces' arrays against each other, and their windows against the pixels."""
    with_surface = [name for name, segment in frame.segments.items() if segment.surface]
    if list(frame.surfaces) != with_surface:
        frame.wrong("", "names", with_surface, list(frame.surfaces), SURFACES)
    for name, segment in frame.segments.items():
        if segment.surface == bool(segment.reason):
            frame.wrong(name, "reason", "one where there is no surface", repr(segment.reason))
    height, width = frame.shape
    box_of = dict(enumerate(find_objects(frame.leaf_image), start=1))
    for name, surface in frame.surfaces.items():
        if name not in frame.segments:
            continue
        if found := malformed(surface):
            frame.wrong(name, *found, SURFACES)
        boxes = [box for leaf in frame.below(name) if (box := box_of.get(leaf.leaf or 0))]
        pixels = frame.measured.get(name, np.zeros(0, dtype=np.int64))
        rows = np.concatenate([pixels // width, *((box[0].start, box[0].stop - 1) for box in boxes)])
        columns = np.concatenate([pixels % width, *((box[1].start, box[1].stop - 1) for box in boxes)])
        top, left, bottom, right = surface.window
        if rows.size:
            first, end = (rows.min(), columns.min()), (rows.max() + 1, columns.max() + 1)
            if not (top <= first[0] and left <= first[1] and end[0] <= bottom and end[1] <= right):
                whole = tuple(int(each) for each in (*first, *end))
                frame.wrong(name, "window", f"to hold all pixels, {whole}", surface.window, SURFACES)
        if not (0 <= top < bottom <= height and 0 <= left < right <= width):
            frame.wrong(name, "window", f"part of the image {frame.shape}", surface.window, SURFACES)


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
        By the order along u and v: meters, per pixel to the power of the order.

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
