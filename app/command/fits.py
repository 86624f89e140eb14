"""Compiles the fits of surfaces into the cache on disk, for the run that started it."""

from __future__ import annotations

import numpy as np

from nurbseg.segmentation.surfaces.bspline import pixel_basis
from nurbseg.segmentation.surfaces.leastsquares import fit_splines


def main() -> None:
    """Fit a spline to a plane, with the argument types of a frame's fits."""
    basis = pixel_basis(8, 5)
    fit_splines(np.ones((1, 8, 8), np.float32), np.ones((8, 8), np.bool_), (0, 0), basis, basis, 0.1)


if __name__ == "__main__":
    main()
