"""The surfaces of a frame as an NPZ file."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.vocabulary import display_name


def surfaces_npz(tree: SegmentationTree) -> bytes:
    """Return the surfaces of a tree's segments as an NPZ file.

    It holds ``names`` (S,) of the segments that have a surface, ``degree`` (S, 2), ``window`` (S, 4) in
    pixels (first row, first column, one past the last of each), and of the segment ``P010`` the arrays
    ``P010_knots_u``, ``P010_knots_v`` in pixels, ``P010_control_points_m`` (n, m, 3) and
    ``P010_weights`` (n, m). Of every segment there is ``P010_measured`` (N,): flat indices of the pixels on
    which its values were measured, ascending, each as its difference to the one before.
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
