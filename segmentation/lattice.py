"""All surfaces of a frame at once: their inverse depth on and between the places of the grid."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.bspline import CUBIC, basis_matrix
from nurbseg.segmentation.surface import NurbsSurface


class SurfaceLattice:
    """Inverse depths of surfaces, each on the part of a grid that it reaches.

    One call for each of fifty surfaces costs more than the arithmetic does; here a place of any surface is
    an index into one array.

    Parameters
    ----------
    surfaces : sequence of NurbsSurface or None
        Of the labels 1, 2, ...; a label without one has no inverse depth anywhere.
    step : int
        Pixels from one place of the grid to the next.
    known : SurfaceLattice, optional
        Another one, from which surfaces that it shares with this one are taken over.
    """

    def __init__(
        self, surfaces: Sequence[NurbsSurface | None], step: int, known: SurfaceLattice | None = None
    ) -> None:
        self._step: int = step
        self._images: dict[int, tuple[NurbsSurface, int, int, NDArray[np.float32]]] = {}
        shared = known._images if known is not None and known._step == step else {}
        count = len(surfaces) + 1
        # Label 0 is no segment: its window is empty.
        self._window = np.zeros((4, count), dtype=np.int32)
        self._start = np.zeros(count, dtype=np.int32)
        values, start = [], 0
        for label, surface in enumerate(surfaces, start=1):
            if surface is None:
                continue
            found = shared.get(id(surface))
            if found is None:
                found = surface, *_evaluated(surface, step)
            # The surface is kept with its image, so that no other one can have its identity.
            self._images[id(surface)] = found
            _, top, left, image = found
            self._window[:, label] = top, left, *image.shape
            self._start[label] = start
            start += image.size
            values.append(image.ravel())
        # The last one is for places that a surface does not reach.
        self._values = np.concatenate([*values, np.full(1, np.inf, dtype=np.float32)])

    def at(
        self, labels: NDArray[np.int32], rows: NDArray[np.intp], columns: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """Return the inverse depth of each label's surface at a place of the grid.

        Parameters
        ----------
        labels, rows, columns : (N,) int
            Which surface, and where.

        Returns
        -------
        (N,) float32
            In 1/m; inf where the surface does not reach.
        """
        top, left, height, width = (each[labels] for each in self._window)
        r, c = rows - top, columns - left
        inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
        index = np.where(inside, self._start[labels] + r * width + c, self._values.size - 1)
        return self._values[index]

    def at_pixels(
        self, labels: NDArray[np.int32], rows: NDArray[np.intp], columns: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """Return the inverse depth of surfaces at pixels, linear between places; as `at`."""
        if self._step == 1:
            return self.at(labels, rows, columns)
        return self._between(labels, rows / self._step, columns / self._step)[0]

    def slopes_at(
        self, labels: NDArray[np.int32], u: NDArray[np.float64], v: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return inverse depth and its change by a pixel along columns u and rows v, (N,) each.

        NaN where a surface does not reach; the slopes are those between neighbouring places.
        """
        per_m, along_u, along_v = self._between(labels, v / self._step, u / self._step)
        per_m = np.where(np.isfinite(per_m), per_m, np.nan)
        return (
            per_m.astype(np.float64),
            along_u.astype(np.float64) / self._step,
            along_v.astype(np.float64) / self._step,
        )

    def _between(
        self, labels: NDArray[np.int32], rows: NDArray[np.float64], columns: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        top, left, height, width = (each[labels] for each in self._window)
        r, c = rows - top, columns - left
        inside = (r >= 0) & (r <= height - 1) & (c >= 0) & (c <= width - 1) & (height > 1) & (width > 1)
        r0 = np.clip(r.astype(np.int32), 0, np.maximum(height - 2, 0))
        c0 = np.clip(c.astype(np.int32), 0, np.maximum(width - 2, 0))
        last = self._values.size - 1
        index = np.where(inside, self._start[labels] + r0 * width + c0, last)
        v = self._values
        below = np.where(inside, index + width, last)
        beside = inside.astype(np.int32)
        a, b, d, e = v[index], v[index + beside], v[below], v[below + beside]
        fr, fc = (r - r0).astype(np.float32), (c - c0).astype(np.float32)
        with np.errstate(invalid="ignore"):
            upper, lower = a + (b - a) * fc, d + (e - d) * fc
            along_u = (b - a) + ((e - d) - (b - a)) * fr
            per_m = upper + (lower - upper) * fr
            per_m[~inside] = np.inf
            return per_m, along_u, lower - upper

    def image(self, labels: NDArray[np.int32]) -> NDArray[np.float32]:
        """Return the inverse depth of each place's own surface, (h, w) float32; inf where there is none."""
        height, width = labels.shape
        flat = labels.ravel()
        top, left, tall, wide = self._window
        # Rows and columns of a place within its label's window, without arrays of rows and columns.
        index = (self._start - top * wide - left)[flat].reshape(labels.shape)
        index += np.arange(height, dtype=np.int32)[:, np.newaxis] * wide[labels]
        index += np.arange(width, dtype=np.int32)
        rows, columns = np.arange(height)[:, np.newaxis], np.arange(width)
        outside = (rows < top[labels]) | (rows >= (top + tall)[labels])
        outside |= (columns < left[labels]) | (columns >= (left + wide)[labels])
        index[outside] = self._values.size - 1
        return self._values[index]


def _evaluated(surface: NurbsSurface, step: int) -> tuple[int, int, NDArray[np.float32]]:
    """Return the first row and column of a surface's domain on the grid, and its inverse depth there."""
    rows, Bv = _along(surface.knots_v, surface.degree[1], surface.weights.shape[0], step)
    columns, Bu = _along(surface.knots_u, surface.degree[0], surface.weights.shape[1], step)
    depths = surface.control_points_m[..., 2] * surface.weights
    if np.ptp(depths) <= 1e-9:
        # The rational surfaces of inverse depth: the ray's z is 1.
        image = Bv @ (surface.weights * (1.0 / depths[0, 0])).astype(np.float32) @ Bu.T
    else:
        image = (Bv @ surface.weights.astype(np.float32) @ Bu.T) / (Bv @ depths.astype(np.float32) @ Bu.T)
    return rows, columns, np.asarray(image, dtype=np.float32)


def _along(knots: NDArray[np.float64], degree: int, count: int, step: int) -> tuple[int, NDArray[np.float32]]:
    """Return the first place of a knot vector's domain, and the basis at the places in it."""
    first, last = float(knots[degree]), float(knots[count])
    spacing = float(knots[1] - knots[0])
    start = round(float(knots[0]) / spacing) if spacing > 0 else 0
    size = int(np.floor(last / step + 1e-9)) - int(np.ceil(first / step - 1e-9)) + 1
    begin = int(np.ceil(first / step - 1e-9))
    is_shared = spacing > 0 and degree == CUBIC and abs(start * spacing - float(knots[0])) < 1e-6 * spacing
    if is_shared and abs(float(knots[-1] - knots[0]) - (knots.size - 1) * spacing) < 1e-6 * spacing:
        return begin, _shared_basis(spacing / step, begin, size, start, count)
    places = (begin + np.arange(size, dtype=np.float64)) * step
    return begin, basis_matrix(knots, degree, places).astype(np.float32)


@lru_cache(maxsize=1024)
def _shared_basis(spacing: float, begin: int, size: int, start: int, count: int) -> NDArray[np.float32]:
    """Return the cubic basis on knots at every multiple of a spacing, in places, (size, count)."""
    knots = (start + np.arange(count + CUBIC + 1, dtype=np.float64)) * spacing
    places = begin + np.arange(size, dtype=np.float64)
    return np.asarray(basis_matrix(knots, CUBIC, places), dtype=np.float32)


__all__ = ["SurfaceLattice"]
