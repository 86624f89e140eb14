"""A triangle mesh of surfaces."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SurfaceMesh:
    """Triangles on the fitted surfaces of all leaves.

    Parameters
    ----------
    vertices_m : (V, 3) float32
        Points on the surfaces, meters, in the depth camera's frame.
    normals : (V, 3) float32
        Unit normals that look toward the camera.
    triangles : (T, 3) uint32
        Rows of `vertices_m`.
    residuals_m : (V,) float32
        Mean distance of the data around each vertex to the surface, meters.
    labels : (V,) uint16
        Label of the segment that each vertex belongs to.
    isolines : (N,) uint32
        Rows of `vertices_m` on lines of constant parameter, line after line.
    isoline_sizes : (L,) intp
        Vertices of each line.
    """

    vertices_m: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    residuals_m: NDArray[np.float32]
    labels: NDArray[np.uint16]
    isolines: NDArray[np.uint32]
    isoline_sizes: NDArray[np.intp]

    def __repr__(self) -> str:
        return f"SurfaceMesh({len(self.vertices_m)} vertices, {len(self.triangles)} triangles)"
