"""A second fit of the surfaces, after their borders have moved on the grid."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.borders import refine_borders
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.inverse_depth import DepthFitter
from nurbseg.segmentation.surfaces.surface import NurbsSurface
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

#: A surface is fitted again if this share of its grid pixels was added or removed.
_MOVED_SHARE = 0.03
#: Sweeps on the grid; those on every pixel follow.
_SWEEPS = 2


def refit_surfaces(
    labels: NDArray[np.int32], fits: Sequence[Fit], fitter: DepthFitter, config: SegmentationConfig
) -> tuple[NDArray[np.int32], list[NurbsSurface | None], list[float]]:
    """Refine the borders on the grid, and fit surfaces again that changed much.

    Cuts often leave a strip along a border on the wrong side, which distorts the surface. A second fit tells
    better where two surfaces meet. The tree keeps the fits that decided it.

    Parameters
    ----------
    labels : (h, w) int32
        Of the grid pixels, 1 to the number of fits; 0 where there is no point.
    fits : sequence of Fit
        Of each label.
    fitter : DepthFitter
        Fits surfaces to the grid pixels of the frame.
    config : SegmentationConfig
        As for `refine_borders`.

    Returns
    -------
    labels : (h, w) int32
        With borders that have moved.
    surfaces, rms_per_m : list of NurbsSurface or None, list of float
        Of each label, by which borders and contacts are judged, and its root mean square residual, 1/m.
    """
    surfaces, rms_per_m = [fit.surface for fit in fits], [fit.rms_per_m for fit in fits]
    grid = fitter.grid
    moved = refine_borders(
        labels,
        grid.inverse_depth,
        SurfaceTable(surfaces),
        config,
        rms_per_m=rms_per_m,
        step=grid.step,
        sweeps=_SWEEPS,
        spread_severed=False,
    )
    changed = moved != labels
    changes = np.bincount(moved[changed], minlength=len(fits) + 1)
    changes += np.bincount(labels[changed], minlength=len(fits) + 1)
    again = np.flatnonzero(changes[1:] > _MOVED_SHARE * np.array([fit.residuals_m.size for fit in fits]))
    number_of = np.zeros(len(fits) + 1, dtype=np.int64)
    number_of[1 + again] = np.arange(1, again.size + 1)
    for place, (_, fit) in zip(again.tolist(), fitter.of_labels(moved, number_of), strict=True):
        if fit.surface is not None:
            surfaces[place], rms_per_m[place] = fit.surface, fit.rms_per_m
    return moved, surfaces, rms_per_m
