"""Splines of inverse depth for many sets of grid pixels at once, by sums over the cells of one lattice.

The knots of all splines are multiples of one spacing. They divide the grid into cells, in each of which
sixteen products of a row and a column function are not zero. The normal equations of a set are sums over its
cells, and those of a union of sets are sums over the cells of its members: no pixel is read again.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, I64, Intp, compiled, inlined, inlined_once
from nurbseg.segmentation.labels.runs import BEGIN, END
from nurbseg.segmentation.surfaces.bspline import CUBIC, Lattice
from nurbseg.segmentation.surfaces.leastsquares import RIDGE_SHARE, factorize, scatter, substitute
from nurbseg.segmentation.surfaces.metrics import metrics_of_sums
from nurbseg.segmentation.surfaces.noise import noise_floor

#: Columns of the table of sets after those of their runs: first row and column, one past the last of each;
#: the number of grid pixels; and the first cell of those between the corners, row by row.
TOP, LEFT, BOTTOM, RIGHT, PIXELS, CELLS = range(2, 8)
#: Columns of the table of splines: the first value; control values along v and u; the outcome; the number of
#: points; and the window of the image: first row and column, and one past the last of each.
VALUES, ALONG_V, ALONG_U, OUTCOME, POINTS, WINDOW, SPLINE = 0, 1, 2, 3, 4, 5, 9
#: Columns of the table of measures after the residual metrics: the floor of the deciding metric, and the root
#: mean square residual of inverse depth, each limited, 1/m.
FLOOR, RMS, MEASURES = 4, 5, 6
#: Outcomes: no finite solution; a control value that points hold is not positive; success.
UNSOLVED, NOT_POSITIVE, SOLVED = range(3)
#: Least inverse depth of a surface where no point supports it, 1/m: weights are positive.
_LEAST_PER_M = 1e-2
#: A control value with less support than this may be changed without harm to the fit.
_SUPPORTED = 1.0
#: Factors on the smoothness, tried in turn where a surface would pass through infinity beyond its points: the
#: first with the margin, those after it with one grid pixel.
_STIFFER = (1.0, 1.0, 1e2, 1e4)


class Frame(NamedTuple):
    """The points of a frame, and what its splines have in common.

    Parameters
    ----------
    inverse_depth, distances_m : (h, w) float32
        Of the grid pixels, 1/m; and from the camera, meters.
    lattice : Lattice
        The functions on the grid.
    spacing : float
        Distance of the knots, grid pixels.
    margin : int
        How far splines extend beyond their sets, grid pixels.
    smoothness : float
        Weight of the squared second differences of the control values along both axes, against the squared
        residuals. Linear functions have none, so that splines extrapolate linearly.
    square_most : float
        A squared residual of inverse depth counts as no more, 1/m^2.
    large_m : float
        A larger distance of a point from a surface is a large error, meters.
    noise_per_m : float
        Standard deviation of inverse depth in the floor, 1/m.
    floor_weights : (float, float, float)
        As `nurbseg.segmentation.surfaces.noise.floor_weights` returns them.
    step, image_width : int, int
        Pixels from one grid pixel to the next, and columns of the image.
    rays, center_u, center_v, scale : (2, 2, 2) float64, float, float, float
        Coefficients, center and scale of rays that are linear.
    """

    inverse_depth: NDArray[np.float32]
    distances_m: NDArray[np.float32]
    lattice: Lattice
    spacing: float
    margin: int
    smoothness: float
    square_most: float
    large_m: float
    noise_per_m: float
    floor_weights: tuple[float, float, float]
    step: int
    image_width: int
    rays: NDArray[np.float64]
    center_u: float
    center_v: float
    scale: float


class Sets(NamedTuple):
    """Sets of grid pixels and their sums; there is room for more.

    Parameters
    ----------
    table : (sets, 8) int64
        The columns of this module and of `nurbseg.segmentation.labels.runs`.
    runs : (runs, 3) int32
        Row, first column and one past the last of each run.
    products : (cells, 10, 10) float64
        Sums over the grid pixels of a cell: products of two row functions and two column functions.
    sides : (cells, 2, 4, 4) float64
        Products of a row and a column function, and these times inverse depth, from which that of the set's
        first point is subtracted so that little is lost to rounding.
    """

    table: NDArray[np.int64]
    runs: NDArray[np.int32]
    products: NDArray[np.float64]
    sides: NDArray[np.float64]


@compiled
def lay_out(store: Sets, first: int, end: int, frame: Frame, used: int) -> tuple[int, int, int]:
    """Measure sets from their runs, and number their cells from `used` on.

    Returns
    -------
    cells, grid_pixels, values : int
        Number of cells that there are now; and of grid pixels, and of values of the splines at most.
    """
    sets, runs, _, _ = store
    spacing, margin = frame.spacing, frame.margin
    grid_pixels = values = 0
    for n in range(first, end):
        top = left = 1 << 30
        bottom = right = size = 0
        for k in range(sets[n, BEGIN], sets[n, END]):
            top, bottom = min(top, runs[k, 0]), runs[k, 0] + 1
            left, right = min(left, runs[k, 1]), max(right, runs[k, 2])
            size += runs[k, 2] - runs[k, 1]
        sets[n, TOP], sets[n, LEFT], sets[n, BOTTOM], sets[n, RIGHT] = top, left, bottom, right
        sets[n, PIXELS], sets[n, CELLS] = size, used
        if size > 0:
            used += _spans(top, bottom, 0, spacing)[1] * _spans(left, right, 0, spacing)[1]
            rows = _spans(top, bottom, margin, spacing)[1] + CUBIC
            columns = _spans(left, right, margin, spacing)[1] + CUBIC
            values += 4 * rows * columns + rows + columns + 8
            grid_pixels += size
    return used, grid_pixels, values


@compiled
def _spans(begin: int, end: int, margin: int, spacing: float) -> tuple[int, int]:
    """Return the first knot span of grid pixels and a margin around them, and the number of spans."""
    # As the lattice counts them: `//` differs from it where a knot is on a grid pixel but for rounding.
    first = math.floor((begin - margin) / spacing)
    return first, math.floor((end - 1 + margin) / spacing) - first + 1


@compiled
def sum_cells(store: Sets, first: int, end: int, frame: Frame) -> None:
    """Fill in the sums over the grid pixels of sets that `lay_out` has measured, cell by cell."""
    (sets, runs, products, sides), inverse_depth = store, frame.inverse_depth
    spans_v, spans_u, by_row, along, edges, sums_u = frame.lattice
    b0, b1, b2, b3 = along[0], along[1], along[2], along[3]
    # By span of columns: all rows that fill the cell have the same sums along it, which are used once.
    full, sums = np.zeros((edges.size, 14)), np.empty(14)
    for n in range(first, end):
        k, stop, cells = sets[n, BEGIN], sets[n, END], sets[n, CELLS]
        if k == stop:
            continue
        center = np.float64(inverse_depth[runs[k, 0], runs[k, 1]])
        first_v, first_u = spans_v[sets[n, TOP]], spans_u[sets[n, LEFT]]
        width = spans_u[sets[n, RIGHT] - 1] - first_u + 1
        count = (spans_v[sets[n, BOTTOM] - 1] - first_v + 1) * width
        products[cells : cells + count] = 0.0
        sides[cells : cells + count] = 0.0
        while k < stop:
            v = spans_v[runs[k, 0]]
            at = cells + (v - first_v) * width - first_u
            while k < stop and spans_v[runs[k, 0]] == v:
                row, begin, last = runs[k, 0], runs[k, 1], runs[k, 2]
                s = spans_u[begin]
                while begin < last:
                    edge = min(last, edges[s + 1])
                    cell = np.uint32(at + s)
                    if edge - begin == edges[s + 1] - edges[s]:
                        for i in range(14):
                            full[s, i] += by_row[row, i]
                    else:
                        for i in range(14):
                            sums[i] = sums_u[edge + s, i] - sums_u[begin + s, i]
                        _add(by_row, row, sums, products, sides, cell)
                    m0 = m1 = m2 = m3 = 0.0
                    for x in range(np.uint32(begin), np.uint32(edge)):
                        value = np.float64(inverse_depth[row, x]) - center
                        m0, m1 = m0 + value * b0[x], m1 + value * b1[x]
                        m2, m3 = m2 + value * b2[x], m3 + value * b3[x]
                    for i in range(4):
                        weight = by_row[row, 10 + i]
                        sides[cell, 1, i, 0] += weight * m0
                        sides[cell, 1, i, 1] += weight * m1
                        sides[cell, 1, i, 2] += weight * m2
                        sides[cell, 1, i, 3] += weight * m3
                    begin = edge
                    s += 1
                k += 1
            for s in range(first_u, first_u + width):
                if full[s, 11] == 0.0:
                    continue
                cell = np.uint32(at + s)
                for j in range(14):
                    sums[j] = sums_u[edges[s + 1] + s, j]
                _add(full, s, sums, products, sides, cell)
                full[s] = 0.0


@inlined
def _add(by_row: F64, row: int, sums: F64, products: F64, sides: F64, cell: np.uint32) -> None:
    for i in range(10):
        for j in range(10):
            products[cell, i, j] += by_row[row, i] * sums[j]
    for i in range(4):
        for j in range(4):
            sides[cell, 0, i, j] += by_row[row, 10 + i] * sums[10 + j]


@compiled
def fit_splines(
    store: Sets,
    first: int,
    members: I64,
    bounds: I64,
    frame: Frame,
    splines: I64,
    measures: F64,
    values: F64,
    pixels: tuple[Intp, Intp],
    residuals_m: F64,
) -> None:
    """Fit splines to the sets from `first` on, and measure how well they explain the points.

    Parameters
    ----------
    store, first : Sets, int
        As `lay_out` leaves them.
    members, bounds : (M,) int64, (N + 1,) int64
        Numbers of the summed sets of which each set to fit is the union, and where these begin and end.
    frame : Frame
        The points.
    splines, measures : (N, 9) int64, (N, 6) float64
        Filled in: the tables of splines, and of how well they explain their points.
    values : (V,) float64
        Filled in for each spline: its control values, 1/m; the control points, meters; the knots along
        columns and along rows, pixels.
    pixels, residuals_m : ((P,) intp, (P,) intp), (P,) float64
        Filled in for each set: its grid pixels, the same in the image, and the distances from the spline.
    """
    sets, spacing, images = store.table, frame.spacing, (frame.inverse_depth, frame.distances_m)
    rim, at, point = np.empty(frame.inverse_depth.shape[1]), 0, 0
    for n in range(bounds.size - 1):
        number = first + n
        top, left, bottom, right = sets[number, 2], sets[number, 3], sets[number, 4], sets[number, 5]
        size, margin, outcome = sets[number, PIXELS], frame.margin, UNSOLVED
        splines[n], measures[n] = 0, 0.0
        if size == 0:
            continue
        for stiffer in _STIFFER:
            (v, nv), (u, nu) = _spans(top, bottom, margin, spacing), _spans(left, right, margin, spacing)
            nv, nu = nv + CUBIC, nu + CUBIC
            control = values[at : at + nv * nu].reshape((nv, nu))
            own = members[bounds[n] : bounds[n + 1]]
            outcome = _solve(store, own, frame, v, u, stiffer * frame.smoothness, control)
            if outcome != NOT_POSITIVE:
                break
            margin = 1
        splines[n, VALUES], splines[n, ALONG_V], splines[n, ALONG_U] = at, nv, nu
        splines[n, OUTCOME], splines[n, POINTS] = outcome, size
        splines[n, WINDOW], splines[n, WINDOW + 1] = top * frame.step, left * frame.step
        splines[n, WINDOW + 2] = (bottom - 1) * frame.step + 1
        splines[n, WINDOW + 3] = (right - 1) * frame.step + 1
        _list_pixels(store, number, frame, pixels, point)
        if outcome != UNSOLVED:
            _measure_residuals(store, number, frame, v, u, control, residuals_m, point, measures[n])
            deviation_and_limit = frame.noise_per_m, frame.large_m
            own_runs = store.runs[sets[number, BEGIN] : sets[number, END]]
            total = noise_floor(own_runs, images, deviation_and_limit, frame.floor_weights, rim)
            measures[n, FLOOR] = total / size
            _place(frame, v, u, control, values, at + nv * nu)
            at += 4 * nv * nu + nv + nu + 8
        point += size


@inlined_once
def _solve(
    store: Sets, members: I64, frame: Frame, first_v: int, first_u: int, smoothness: float, control: F64
) -> int:
    """Solve the normal equations of a union of sets for (nv, nu) control values; return the outcome.

    The first control value belongs to the first function that is not zero on the given spans.
    """
    (sets, runs, products, sides), inverse_depth = store, frame.inverse_depth
    spans_v, spans_u = frame.lattice.spans_v, frame.lattice.spans_u
    nv, nu = control.shape
    # Numbering control points along the direction that has fewer gives the narrower band.
    step_v, step_u = (nu, 1) if nu <= nv else (1, nv)
    size = nv * nu
    # Row n of the band: entries of the normal matrix for n and itself, n + 1, ...
    band = np.zeros((size, min(3 * min(nv, nu) + 3, size - 1) + 1))
    ones, right, held = np.zeros(size), np.zeros(size), np.empty(size)
    start = sets[members[0], BEGIN]
    center = np.float64(inverse_depth[runs[start, 0], runs[start, 1]])
    for m in members:
        start, cell = sets[m, BEGIN], sets[m, CELLS]
        shift = np.float64(inverse_depth[runs[start, 0], runs[start, 1]]) - center
        for v in range(spans_v[sets[m, TOP]], spans_v[sets[m, BOTTOM] - 1] + 1):
            for u in range(spans_u[sets[m, LEFT]], spans_u[sets[m, RIGHT] - 1] + 1):
                if sides[cell, 0, 1, 1] > 0.0:
                    at = np.uint32((v - first_v) * step_v + (u - first_u) * step_u)
                    scatter(products, cell, at, (step_v, step_u), band)
                    for i in range(4):
                        for j in range(4):
                            to = np.uint32(at + i * step_v + j * step_u)
                            ones[to] += sides[cell, 0, i, j]
                            right[to] += sides[cell, 1, i, j] + shift * sides[cell, 0, i, j]
                cell += 1
    # About the mean, which control values without support tend to; all functions sum to 1 at a point.
    offset = right.sum() / ones.sum()
    center += offset
    for k in range(size):
        right[k] -= offset * ones[k]
        held[k] = band[k, 0]
    _add_smoothness(band, smoothness, nv, step_v, nu, step_u)
    _add_smoothness(band, smoothness, nu, step_u, nv, step_v)
    largest = 0.0
    for k in range(size):
        largest = max(largest, band[k, 0])
    for k in range(size):
        band[k, 0] += RIDGE_SHARE * largest
    if not factorize(band):
        return UNSOLVED
    substitute(band, right)
    outcome = SOLVED
    for a in range(nv):
        for b in range(nu):
            k = a * step_v + b * step_u
            value = right[k] + center
            if not abs(value) < np.inf:
                return UNSOLVED
            if value <= _LEAST_PER_M and held[k] > _SUPPORTED:
                outcome = NOT_POSITIVE
            control[a, b] = max(value, _LEAST_PER_M)
    return outcome


@compiled
def _add_smoothness(band: F64, weight: float, n: int, step: int, lines: int, across: int) -> None:
    """Add the squared second differences of control values along one axis to the normal matrix."""
    for line in range(lines):
        for k in range(n - 2):
            at = line * across + k * step
            band[at, 0] += weight
            band[at, step] -= 2.0 * weight
            band[at, 2 * step] += weight
            band[at + step, 0] += 4.0 * weight
            band[at + step, step] -= 2.0 * weight
            band[at + 2 * step, 0] += weight


@inlined_once
def _list_pixels(store: Sets, number: int, frame: Frame, pixels: tuple[Intp, Intp], point: int) -> None:
    """List the grid pixels of a set, flat in the grid and in the image."""
    (sets, runs, _, _), (grid_pixels, in_image) = store, pixels
    width = frame.inverse_depth.shape[1]
    for k in range(sets[number, BEGIN], sets[number, END]):
        row = runs[k, 0]
        for x in range(runs[k, 1], runs[k, 2]):
            grid_pixels[np.uint32(point)] = row * width + x
            in_image[np.uint32(point)] = (row * frame.image_width + x) * frame.step
            point += 1


@inlined_once
def _measure_residuals(
    store: Sets,
    number: int,
    frame: Frame,
    first_v: int,
    first_u: int,
    control: F64,
    residuals_m: F64,
    point: int,
    own: F64,
) -> None:
    """Compute the distances of points from a spline, the metrics, and the root mean square residual."""
    (sets, runs, _, _), inverse_depth, distances_m = store, frame.inverse_depth, frame.distances_m
    spans_v, spans_u, by_row, along, edges, _ = frame.lattice
    b0, b1, b2, b3 = along[0], along[1], along[2], along[3]
    largest = total = squares = limited = 0.0
    square_most, large_m = frame.square_most, frame.large_m
    large = 0
    for k in range(sets[number, BEGIN], sets[number, END]):
        row, begin, end = runs[k, 0], runs[k, 1], runs[k, 2]
        w0, w1, w2, w3 = by_row[row, 10], by_row[row, 11], by_row[row, 12], by_row[row, 13]
        v, s = spans_v[row] - first_v, spans_u[begin]
        while begin < end:
            edge, u = min(end, edges[s + 1]), s - first_u
            c0 = w0 * control[v, u] + w1 * control[v + 1, u] + w2 * control[v + 2, u] + w3 * control[v + 3, u]
            u += 1
            c1 = w0 * control[v, u] + w1 * control[v + 1, u] + w2 * control[v + 2, u] + w3 * control[v + 3, u]
            u += 1
            c2 = w0 * control[v, u] + w1 * control[v + 1, u] + w2 * control[v + 2, u] + w3 * control[v + 3, u]
            u += 1
            c3 = w0 * control[v, u] + w1 * control[v + 1, u] + w2 * control[v + 2, u] + w3 * control[v + 3, u]
            x, at = np.uint32(begin), np.uint32(point)
            for n in range(np.uint32(edge - begin)):
                fitted = (b0[x + n] * c0 + b1[x + n] * c1) + (b2[x + n] * c2 + b3[x + n] * c3)
                residual = fitted - inverse_depth[row, x + n]
                square = residual * residual
                limited += square if square < square_most else square_most
                # Both points lie on one ray.
                distance_m = abs(residual) * distances_m[row, x + n] / fitted
                residuals_m[at + n] = distance_m
                largest = distance_m if distance_m > largest else largest
                total += distance_m
                squares += distance_m * distance_m
                large += distance_m > large_m
            point += edge - begin
            begin = edge
            s += 1
    size = sets[number, PIXELS]
    own[0], own[1], own[2], own[3] = metrics_of_sums(size, largest, total, squares, large)
    own[RMS] = math.sqrt(limited / size)


@inlined_once
def _place(frame: Frame, first_v: int, first_u: int, control: F64, values: F64, at: int) -> None:
    """Fill in control points on linear rays, at the Greville abscissae, and the knots along u and v."""
    (nv, nu), spacing, rays = control.shape, frame.spacing, frame.rays
    # Function number i is not zero between knots i - 3 and i + 1, the middle one of which is its abscissa.
    for a in range(nv):
        t = (spacing * (first_v - 1 + a) * frame.step - frame.center_v) / frame.scale
        for b in range(nu):
            s = (spacing * (first_u - 1 + b) * frame.step - frame.center_u) / frame.scale
            for axis in range(2):
                ray = rays[axis, 0, 0] + rays[axis, 1, 0] * s + rays[axis, 0, 1] * t
                values[at + axis] = ray / control[a, b]
            values[at + 2] = 1.0 / control[a, b]
            at += 3
    for first, count in ((first_u, nu), (first_v, nv)):
        for k in range(count + CUBIC + 1):
            values[at] = spacing * (first - CUBIC + k) * frame.step
            at += 1
