"""Compiles the fits of surfaces into the cache on disk, for the run that started it."""

from __future__ import annotations

import numpy as np

from nurbseg.segmentation.surfaces.bspline import pixel_basis
from nurbseg.segmentation.surfaces.inverse_depth import fit_inverse_depth


def main() -> None:
    """Fit a spline to a plane, with the argument types of a frame's fits."""
    basis, plane = pixel_basis(8, 5), np.ones((1, 8, 8), np.float32)
    fit_inverse_depth(plane, plane[0], np.ones((8, 8), np.bool_), (0, 0), basis, basis, 0.1, 1.0)


if __name__ == "__main__":
    main()
