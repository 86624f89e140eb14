"""Segments with their pixels."""

from dataclasses import replace

import numpy as np

from nurbseg.segmentation.segments import Node, SegmentationTree, depth_first, finished_segments
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.surface import NurbsSurface
from nurbseg.segmentation.vocabulary import StopReason


def node(name: str, *children: Node) -> Node:
    """A node without a surface."""
    nothing = np.zeros(0, dtype=np.intp)
    fit = Fit(None, np.zeros(0), {}, "", nothing)
    stop = None if children else StopReason.NOISE
    return Node(name, nothing, fit, children, stop=stop)  # type: ignore[arg-type]


def test_a_segment_has_the_pixels_of_the_leaves_below_it() -> None:
    root = node("", node("0", node("00"), node("01")), node("1"))
    image = np.array([[1, 2, 0], [3, 2, 1]], np.uint16)
    segments = finished_segments(depth_first(root), image)
    pixels = {segment.name: segment.pixels.tolist() for segment in segments}
    assert pixels == {"": [0, 5, 1, 4, 3], "0": [0, 5, 1, 4], "00": [0, 5], "01": [1, 4], "1": [3]}
    assert [(segment.name, segment.parent, segment.children) for segment in segments[:2]] == [
        ("", None, ("0", "1")),
        ("0", "", ("00", "01")),
    ]
    # The image is what it would be if it had to be made of the segments.
    assert np.array_equal(SegmentationTree(segments, (2, 3)).labels("surfaces"), image)
    assert SegmentationTree(segments, (2, 3), image=image).labels("surfaces") is image


def test_the_window_of_a_surface_holds_what_it_was_fitted_to_and_all_pixels() -> None:
    knots, ones = np.array([0.0, 0, 1, 1]), np.ones((2, 2))
    surface = NurbsSurface((1, 1), knots, knots, np.ones((2, 2, 3)), ones, (2, 2, 4, 4))
    nodes = depth_first(node("", node("0", node("00"), node("01")), node("1")))
    for each in nodes:
        each.fit = replace(each.fit, surface=surface)
    # The third leaf has no pixel inside the windows of the others.
    image = np.zeros((7, 9), np.uint16)
    image[1:3, 3:5], image[3:6, 5], image[0, 0], image[6, 8] = 1, 2, 3, 3
    for segment in finished_segments(nodes, image):
        rows, columns = np.divmod(segment.pixels, 9)
        box = min(2, *rows), min(2, *columns), max(4, *rows + 1), max(4, *columns + 1)
        assert segment.fit.surface is not None
        assert segment.fit.surface.window == box
