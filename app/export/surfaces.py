"""The surfaces of a frame as an NPZ file."""

import io
from typing import Any

import numpy as np

from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.vocabulary import display_name


def surfaces_npz(tree: SegmentationTree) -> bytes:
    """Return the surfaces of a tree's segments as an NPZ file.

    docs/files.md describes its arrays.
    """
    arrays: dict[str, Any] = {}
    names, degrees, windows = [], [], []
    for each in tree.segments:
        name, surface = display_name(each.name), each.fit.surface
        arrays[f"{name}_measured"] = np.diff(each.fit.pixels, prepend=0).astype(np.int32)
        if surface is None:
            continue
        names.append(name)
        degrees.append(surface.degree)
        windows.append(surface.window)
        for part in ("knots_u", "knots_v", "control_points_m", "weights"):
            arrays[f"{name}_{part}"] = getattr(surface, part)
    arrays["names"] = np.array(names, dtype=np.str_)
    arrays["degree"] = np.array(degrees, dtype=np.int32).reshape(-1, 2)
    arrays["window"] = np.array(windows, dtype=np.int32).reshape(-1, 4)
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()
