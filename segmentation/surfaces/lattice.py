"""Inverse depths of all surfaces of a frame, on the grid pixels."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I32, I64, compiled
from nurbseg.segmentation.surfaces.bspline import CUBIC, even_values
from nurbseg.segmentation.surfaces.surface import NurbsSurface

#: Rounding of knots that are on the grid, grid pixels.
_ROUNDING = 1e-9


class Samples(NamedTuple):
    """Inverse depths of surfaces on their windows, as compiled functions take them.

    Parameters
    ----------
    values : (N,) float32
        Inverse depths, 1/m, window after window in row order.
    windows : (labels + 1, 5) int32
        Of each label: first row and column of the grid that its surface reaches, one past the last of each,
        and the index of the first in `values`. Empty for 0, which is no label.
    """

    values: NDArray[np.float32]
    windows: NDArray[np.int32]


class SurfaceLattice:
    """Inverse depths of surfaces, each on the part of a grid that it reaches.

    All are in one array, as a call for each of fifty surfaces would cost more than the arithmetic.

    Parameters
    ----------
    surfaces : sequence of NurbsSurface or None
        Of the labels 1, 2, ..., as fitted to inverse depth: cubic on evenly spaced knots, with weights that
        are control values of inverse depth. A label without a surface has no inverse depth anywhere.
    step : int
        Pixels from one grid pixel to the next.

    Attributes
    ----------
    samples : Samples
        The inverse depths.
    """

    def __init__(self, surfaces: Sequence[NurbsSurface | None], step: int) -> None:
        self.step = step
        labels = [label for label, surface in enumerate(surfaces, start=1) if surface is not None]
        known = [surface for surface in surfaces if surface is not None]
        shapes = np.array([each.weights.shape for each in known], dtype=np.int64).reshape(-1, 2)
        # First knot and spacing along rows and columns, grid pixels.
        knots = np.array(
            [(each.knots_v[0], each.knots_v[1], each.knots_u[0], each.knots_u[1]) for each in known],
            dtype=np.float64,
        ).reshape(-1, 2, 2)
        knots /= step
        first, spacing = knots[..., 0].copy(), knots[..., 1] - knots[..., 0]
        start = np.ceil(first + CUBIC * spacing - _ROUNDING)
        stop = np.floor(first + shapes * spacing + _ROUNDING) + 1
        sizes = np.prod(stop - start, axis=1)
        ends = np.cumsum(sizes)
        windows = np.zeros((len(surfaces) + 1, 5), dtype=np.int32)
        windows[labels] = np.column_stack([start, stop, ends - sizes])
        self.samples = Samples(np.empty(int(sizes.sum()), dtype=np.float32), windows)
        if known:
            nets = np.concatenate([each.weights.ravel() for each in known]).astype(np.float32)
            _evaluate(nets, shapes, first, spacing, Samples(self.samples.values, windows[labels]))

    def changed(
        self, constant: NDArray[np.float64], along_u: NDArray[np.float64], along_v: NDArray[np.float64]
    ) -> SurfaceLattice:
        """Return the surfaces with a linear function added to the inverse depth of each.

        Parameters
        ----------
        constant, along_u, along_v : (labels + 1,) float64
            At the first row and column, 1/m, and its change by one grid pixel along columns and rows.
        """
        changed = copy(self)
        changed.samples = Samples(self.samples.values.copy(), self.samples.windows)
        _add_linear(changed.samples, constant, along_u, along_v)
        return changed

    def image(self, labels: NDArray[np.int32]) -> NDArray[np.float32]:
        """Return the inverse depth of each pixel's own surface, (h, w) float32; inf where there is none."""
        return _take(self.samples, labels)


@compiled
def _evaluate(nets: F32, shapes: I64, first: F64, spacing: F64, samples: Samples) -> None:
    """Evaluate splines on their windows: each row of control values along columns, then all along rows."""
    values, windows = samples
    most, widest = 1, 1
    for k in range(windows.shape[0]):
        most, widest = max(most, shapes[k, 0]), max(widest, windows[k, 3] - windows[k, 1])
    blended = np.empty((most, widest), dtype=np.float32)
    basis = np.empty(4, dtype=np.float32)
    net = 0
    for k in range(windows.shape[0]):
        n, m = shapes[k]
        top, left, bottom, right, start = windows[k]
        width = right - left
        for c in range(width):
            j = net + _cubic((left + c - first[k, 1]) / spacing[k, 1], m, basis)
            for i in range(n):
                at = j + i * m
                blended[i, c] = (
                    basis[0] * nets[at]
                    + basis[1] * nets[at + 1]
                    + basis[2] * nets[at + 2]
                    + basis[3] * nets[at + 3]
                )
        for r in range(bottom - top):
            i = _cubic((top + r - first[k, 0]) / spacing[k, 0], n, basis)
            row = values[start + r * width : start + (r + 1) * width]
            for c in range(width):
                row[c] = (
                    basis[0] * blended[i, c]
                    + basis[1] * blended[i + 1, c]
                    + basis[2] * blended[i + 2, c]
                    + basis[3] * blended[i + 3, c]
                )
        net += n * m


@compiled
def _add_linear(samples: Samples, constant: F64, along_u: F64, along_v: F64) -> None:
    """Add to each surface its value at the first row and column, and its slopes along columns and rows."""
    values, windows = samples
    for label in range(windows.shape[0]):
        top, left, bottom, right, at = windows[label]
        for r in range(top, bottom):
            start, slope = np.float32(constant[label] + r * along_v[label]), np.float32(along_u[label])
            for c in range(left, right):
                values[at] += start + slope * np.float32(c)
                at += 1


@compiled
def _cubic(position: float, count: int, basis: F32) -> int:
    """Fill in the four cubic functions that are not zero at a position; return the number of the first."""
    span = min(max(int(np.floor(position)), 3), count - 1)
    basis[0], basis[1], basis[2], basis[3] = even_values(position - span)
    return span - 3


@compiled
def _take(samples: Samples, labels: I32) -> F32:
    values, windows = samples
    height, width = labels.shape
    found = np.empty((height, width), dtype=np.float32)
    for r in range(height):
        label = np.int32(-1)
        for c in range(width):
            if labels[r, c] != label:
                label = labels[r, c]
                top, left, bottom, right, start = windows[label]
                start += (r - top) * (right - left) - left
                if not top <= r < bottom:
                    left = right
            found[r, c] = values[start + c] if left <= c < right else np.inf
    return found
