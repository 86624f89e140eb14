"""What holds in every tree of segments, by either method, of a frame alone and of a live one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.segments import SegmentationTree


def assert_sound(tree: SegmentationTree, valid: NDArray[np.bool_]) -> None:
    """Hold that segments have the pixels of their parts, leaves tile the points, and objects are leaves."""
    names = [each.name for each in tree.segments]
    assert names == sorted({*names})
    for each in tree.segments:
        assert each.parent == (each.name[:-1] if each.name else None)
        assert (each.stop is None) == (each.division is not None) == bool(each.children)
        if each.children:
            assert each.children == (f"{each.name}0", f"{each.name}1")
            parts = [tree[name].pixels for name in each.children]
            assert np.array_equal(np.concatenate(parts), each.pixels)
        if each.fit.surface is not None and each.pixels.size:
            rows, columns = np.divmod(np.concatenate([each.pixels, each.fit.pixels]), tree.shape[1])
            top, left, bottom, right = each.fit.surface.window
            assert top <= rows.min() <= rows.max() < bottom
            assert left <= columns.min() <= columns.max() < right
    labels, leaves = tree.labels("surfaces"), tree.leaves()
    assert labels.dtype == np.uint16
    assert np.array_equal(labels > 0, valid)
    for label, leaf in enumerate(leaves, start=1):
        assert np.array_equal(np.flatnonzero(labels == label), leaf.pixels)
    if tree.objects:
        objects = tree.labels("objects")
        for number, each in enumerate(tree.objects, start=1):
            own = [leaf.pixels for leaf in leaves if leaf.name in each.leaves]
            assert np.array_equal(np.sort(np.concatenate(own)), np.flatnonzero(objects == number))
    with_object = [name for each in tree.objects for name in each.leaves]
    assert sorted(with_object) == sorted(leaf.name for leaf in leaves if tree.objects)
