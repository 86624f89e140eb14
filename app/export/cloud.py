"""The points of a frame as a PLY file: color, normal, surface and object of each."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.models.mesh import ply
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.surfaces.surface import normals


def cloud_file(result: FrameResult) -> bytes:
    """Return the points of a frame with color, normal and labels, binary, little endian.

    Points are in meters in the depth camera's frame; `label` is that of the tree's level.
    """
    vectors = np.concatenate([result.cloud.points_m, surface_normals(result.tree)], axis=2)
    labels = [result.labels(), result.labels("surfaces"), result.labels("objects")]
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
