"""The points of a frame as a PLY or PCD file: color, normal, surface and object of each."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.settings.output_config import CloudForm
from nurbseg.library.models.mesh import ply
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.surfaces.surface import normals


def cloud_file(result: FrameResult, form: CloudForm) -> bytes:
    """Return the points of a frame with color, normal and labels, binary, little endian.

    PLY contains only points; PCD is organized, with NaN for pixels without a point. Points are in meters in
    the depth camera's frame; `label` is that of the tree's level.
    """
    vectors = np.concatenate([result.cloud.points_m, surface_normals(result.tree)], axis=2)
    labels = [result.labels(), result.labels("surfaces"), result.labels("objects")]
    if form == "pcd":
        return _pcd(vectors, result.cloud.color, labels)
    valid = result.cloud.valid
    names = "x,y,z,nx,ny,nz,red,green,blue,label,surface,object"
    kinds = ["<f4"] * 6 + ["|u1"] * 3 + ["<u2"] * 3
    columns = [*vectors[valid].T, *result.cloud.color[valid].T, *(image[valid] for image in labels)]
    return ply(vertex=np.rec.fromarrays(columns, names=names, formats=kinds))


def surface_normals(tree: SegmentationTree) -> NDArray[np.float32]:
    """Return the normal of the fitted surface at each pixel, (H, W, 3) float32.

    Unit vectors toward the camera; 0 for pixels without a surface.
    """
    height, width = tree.shape
    image = np.zeros((height * width, 3), dtype=np.float32)
    for leaf in tree.leaves():
        surface = leaf.fit.surface
        if surface is None:
            continue
        v, u = np.divmod(leaf.pixels, width)
        image[leaf.pixels] = np.nan_to_num(-normals(surface, u, v))
    return image.reshape(height, width, 3)


def _pcd(vectors: NDArray[np.float32], color: NDArray[np.uint8], labels: list[NDArray[np.uint16]]) -> bytes:
    height, width = color.shape[:2]
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb", "label", "surface", "object")
    red, green, blue = color.reshape(-1, 3).astype(np.uint32).T
    columns = [*vectors.reshape(-1, 6).T, red << 16 | green << 8 | blue, *(label.ravel() for label in labels)]
    points = np.rec.fromarrays(columns, formats=["<f4"] * 6 + ["<u4"] * 4)
    head = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(['4'] * len(names))}",
        f"TYPE {' '.join(['F'] * 6 + ['U'] * 4)}",
        f"COUNT {' '.join(['1'] * len(names))}",
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {height * width}",
        "DATA binary",
    )
    return ("\n".join(head) + "\n").encode() + points.tobytes()
