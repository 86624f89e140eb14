"""The numbers in the picture of a frame: on their objects, whole, and in doubt only where an object is."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from nurbseg import FrameResult, open_source, segment
from nurbseg.library.objects import MeasuredObject
from nurbseg.library.picture import outlined
from nurbseg.segmentation.vocabulary import StopReason

DEMO = Path(__file__).parents[2] / "recordings" / "demo.mcap"


@cache
def demo() -> FrameResult:
    with open_source(DEMO) as source:
        return segment(next(iter(source)))


def number(labels: NDArray[np.uint16], each: MeasuredObject) -> NDArray[np.intp]:
    """Return the rows and columns, (N, 2), that the number of an object covers; alone it has no outline."""
    gray = np.full((*labels.shape, 3), 128, dtype=np.uint8)
    return np.argwhere((outlined(gray, labels, [each]) != gray).any(axis=2))


def test_the_middle_of_a_number_is_on_its_object() -> None:
    labels = demo().labels("objects")
    assert len(demo().objects) == 12
    for each in demo().objects:
        row, column = number(labels, each).mean(axis=0).round().astype(int).tolist()
        assert labels[row, column] == each.label


@pytest.mark.parametrize(
    ("rows", "columns"), [((0, 3), (0, 3)), ((97, 100), (117, 120)), ((0, 9), (90, 120))]
)
def test_no_number_is_cut_off_by_an_edge_of_the_image(
    rows: tuple[int, int], columns: tuple[int, int]
) -> None:
    each = replace(demo().objects[0], label=23)
    labels = np.zeros((100, 120), dtype=np.uint16)
    labels[slice(*rows), slice(*columns)] = 23
    middle = np.zeros_like(labels)
    middle[40:60, 40:80] = 23
    assert len(number(labels, each)) == len(number(middle, each)) > 100


def test_what_reaches_out_of_the_image_is_numbered_without_a_question_mark() -> None:
    labels = demo().labels("objects")
    table = max(demo().objects, key=lambda each: each.pixels.size)
    assert table.hidden_share > 0.5 and not table.is_sure
    seen = number(labels, replace(table, hidden_share=0.0))
    np.testing.assert_array_equal(number(labels, table), seen)
    leaf = replace(table.tree[table.leaves[0]], stop=StopReason.PENDING)
    segments = tuple(leaf if each.name == leaf.name else each for each in table.tree.segments)
    pending = replace(table, tree=replace(table.tree, segments=segments))
    assert len(number(labels, pending)) > len(seen)
