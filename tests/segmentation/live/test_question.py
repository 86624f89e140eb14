"""What a frame no longer supports is undone: cuts by their ratio, protrusions by what is in front."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from exact_surface import metric, ratio
from numpy.typing import NDArray
from plates import CONFIG, PLATE_PER_M, PLATES, plates, rising

from nurbseg.common.settings import updated
from nurbseg.segmentation.extended.grid_features import GridFeatures, grid_features
from nurbseg.segmentation.extended.memory import LeafMemory, TreeMemory
from nurbseg.segmentation.extended.parts import fit_segment
from nurbseg.segmentation.live.question import undo_cuts, undo_protrusions
from nurbseg.segmentation.live.tree import Budget, LiveTree
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, SegmentationTree, depth_first, leaves_below
from nurbseg.segmentation.vocabulary import Division, StopReason

CUTS = updated(CONFIG, extended={"protrusion_min": 0.0})
#: A plate of all rows; its grid pixels are columns 20 to 39.
DOOR = (40, 0, 40, 120)


def halves(
    cloud: PointMap, columns: Sequence[int], division: Division = Division.CUT
) -> tuple[Node, GridFeatures]:
    """A root that is divided at a column of the grid, and one of its parts at the next."""
    features = grid_features(cloud, CUTS)

    def part(name: str, first: int, end: int) -> Node:
        inside = (np.arange(features.grid.valid.size) % 80 >= first) & (
            np.arange(features.grid.valid.size) % 80 < end
        )
        node = fit_segment(features, np.flatnonzero(inside), CUTS)
        node.name, node.memory, node.cuts_above = name, LeafMemory(0), len(name)
        return node

    root = part("", 0, 80)
    node, first = root, 0
    for column in columns:
        node.children = part(f"{node.name}0", first, column), part(f"{node.name}1", column, 80)
        node.division, node.memory, node.stop, node.judged = division, None, None, 0
        node, first = node.children[1], column
    return root, features


def judge(
    root: Node,
    features: GridFeatures,
    memory: TreeMemory,
    frame: int,
    room: float = 1e9,
    *,
    every: bool = False,
) -> tuple[int, int]:
    memory.frame = frame
    return undo_cuts(root, memory, features, CUTS, pixels_most=room, every_surface=every)


def test_a_cut_between_two_surfaces_stays_and_one_through_a_surface_is_undone() -> None:
    # The first cut is at the door's edge, the second one is nowhere.
    root, features = halves(plates(DOOR), (40, 60))
    largest = max(root.children[1].children, key=lambda leaf: leaf.grid_pixels.size).memory
    memory = TreeMemory(CUTS)
    for frame in range(1, 8):
        judge(root, features, memory, frame)
    assert root.division is Division.CUT
    (_, wall) = root.children
    assert (wall.children, wall.division, wall.trial, wall.cut) == ((), None, None, None)
    assert wall.memory is largest
    assert wall.stop is StopReason.NOISE
    assert wall.fit.surface is not None


def test_a_cut_is_judged_by_one_surface_for_all_and_those_of_the_leaves() -> None:
    cloud = plates(DOOR)
    root, features = halves(cloud, (20, 40))
    judge(root, features, TreeMemory(CUTS), 1)
    assert root.trial is not None
    leaves = leaves_below(root)
    assert [(root.trial.points, [n for _, n in root.trial.parts])] == [(4800, [1200, 1200, 2400])]
    weighed = []
    for node in (root, *leaves):
        value = metric("mse", node.fit, cloud, CUTS)
        # What noise leaves counts at least.
        weighed.append((max(value, node.fit.floor), node.grid_pixels.size))
    assert root.trial.ratio == pytest.approx(ratio("mse", *weighed), rel=1e-3)
    assert root.trial.kept
    assert root.trial.ratio < 0.5


@pytest.mark.parametrize(("room", "judged"), [(0, 1), (3600, 1), (8000, 1), (8400, 2), (1e9, 2)])
def test_large_segments_are_judged_less_often_while_there_is_room(room: float, judged: int) -> None:
    # 4800 grid pixels, and 3600 below.
    root, features = halves(plates(DOOR), (20, 40))
    memory = TreeMemory(CUTS)
    assert judge(root, features, memory, 1, room)[0] == judged
    assert root.children[1].trial is not None
    assert (root.trial is None) == (judged == 1)
    # What was not judged has its turn.
    for frame in range(2, 5):
        judge(root, features, memory, frame, room)
    assert root.trial is not None


def test_no_cut_waits_longer_than_its_limit() -> None:
    root, features = halves(plates(DOOR), (20, 40))
    memory = TreeMemory(CUTS)
    assert judge(root, features, memory, 1)[0] == 2
    assert judge(root, features, memory, 61, 0.0)[0] == 2


def test_every_cut_gets_its_surface_on_request() -> None:
    for every in (False, True):
        root, features = halves(plates(DOOR), (20, 40))
        for node in (root, root.children[1]):
            node.measured, node.fit = 7, replace(node.fit, surface=None)
        assert judge(root, features, TreeMemory(CUTS), 1, 0.0, every=every)[0] == 1
        assert (root.fit.surface is not None) == (root.measured is None) == every
        assert root.children[1].fit.surface is not None


@pytest.mark.parametrize("division", [Division.GAP, Division.APPEARED, Division.PROTRUSION])
def test_what_no_cut_made_is_not_judged(division: Division) -> None:
    root, features = halves(plates(), (40,), division)
    assert judge(root, features, TreeMemory(CUTS), 1) == (0, 0)
    assert root.division is division


def test_a_doubtful_ratio_undoes_no_cut_in_one_frame() -> None:
    root, features = halves(plates(DOOR), (40,))
    memory = TreeMemory(CUTS)
    for frame in range(1, 4):
        judge(root, features, memory, frame)
    # The door is flush now: the ratio is about 1, which the average passes after many frames.
    flat, features = halves(plates(), (40,))
    flat.memory = root.memory
    undone = []
    for frame in range(4, 60):
        undone.append(judge(flat, features, memory, frame)[1])
        if undone[-1]:
            break
    assert undone[-1] == 1
    assert len(undone) > 1


def labels_in(tree: SegmentationTree, plate: tuple[int, int, int, int]) -> tuple[int, int]:
    """Most frequent labels of a plate's inner pixels, and of the wall above it."""
    left, top, width, height = plate
    inner = tree.labels()[top + 5 : top + height - 5, left + 5 : left + width - 5]
    around = tree.labels()[top - 10 : top - 4, left : left + width]
    return int(np.bincount(inner.ravel()).argmax()), int(np.bincount(around.ravel()).argmax())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("protrusion_min", [0.0, 2.5])
def test_plates_have_leaves_until_they_are_pressed_flat(protrusion_min: float, seed: int) -> None:
    live = LiveTree(updated(CONFIG, seed=seed, extended={"protrusion_min": protrusion_min}))
    for frame in range(40):
        tree = live.segment(rising(min(frame, 20), frame))
        assert (live.report.reset == "") == (frame > 0)
    for plate in PLATES:
        inner, around = labels_in(tree, plate)
        assert inner != around
    # What is just at the limit is given up in the end.
    for frame in range(40):
        nearer = 4 * (PLATE_PER_M * max(0.0, 1 - 0.2 * frame),)
        tree = live.segment(plates(*PLATES, frame=frame, nearer_per_m=nearer))
        assert live.report.reset == ""
    assert len(tree.segments) == 1


def protrusion(nearer_per_m: float) -> tuple[Node, GridFeatures, NDArray[np.intp]]:
    """A root of the wall and a plate before it."""
    cloud = plates(PLATES[0], nearer_per_m=[nearer_per_m])
    features = grid_features(cloud, CONFIG)
    rows, columns = np.mgrid[:60, :80]
    left, top, width, height = (each // 2 for each in PLATES[0])
    inside = (columns >= left) & (columns < left + width) & (rows >= top) & (rows < top + height)
    parts = [fit_segment(features, np.flatnonzero(each), CONFIG) for each in (~inside, inside)]
    root = fit_segment(features, np.arange(4800), CONFIG)
    for n, part in enumerate(parts):
        part.name, part.memory = str(n), LeafMemory(0)
    root.children, root.division, root.stop = (parts[0], parts[1]), Division.PROTRUSION, None
    return root, features, np.flatnonzero(inside)


def test_a_protrusion_lasts_while_it_is_in_front() -> None:
    # It was split off at 2.5 deviations, 0.00125 1/m; a little less does not end it.
    for nearer_per_m in (0.02, 0.00125, 0.0011):
        root, features, inside = protrusion(nearer_per_m)
        assert undo_protrusions(root, features, CONFIG) == 0
        assert np.array_equal(root.children[1].grid_pixels, inside)
    for nearer_per_m in (0.0, -0.02):
        root, features, _ = protrusion(nearer_per_m)
        rest = root.children[0].memory
        assert undo_protrusions(root, features, CONFIG) == 1
        assert (root.name, root.children) == ("", ())
        assert root.memory is rest
        assert np.array_equal(np.sort(root.grid_pixels), np.arange(4800))
        assert root.fit.surface is not None
        assert root.fit.residuals_m.size == 4800


def test_each_of_several_protrusions_is_given_back_by_itself() -> None:
    live = LiveTree(CONFIG)
    both = PLATES[0], PLATES[3]
    live.segment(plates(*both, frame=0, nearer_per_m=(0.0, 0.0)))
    for frame in range(1, 8):
        near = min(0.004 * frame, PLATE_PER_M)
        tree = live.segment(plates(*both, frame=frame, nearer_per_m=(near, near)))
    assert all(one != other for one, other in (labels_in(tree, plate) for plate in both))
    for frame in range(8):
        near = max(0.0, PLATE_PER_M - 0.004 * frame)
        tree = live.segment(plates(*both, frame=frame, nearer_per_m=(near, PLATE_PER_M)))
    first, other = (labels_in(tree, plate) for plate in both)
    assert first[0] == first[1]
    assert other[0] != other[1]


def test_nothing_is_undone_without_room_but_in_turn() -> None:
    live = LiveTree(CUTS)
    for frame in range(24):
        tree = live.segment(rising(frame), Budget(judged_pixels=0))
    cuts = sum(segment.division is Division.CUT for segment in tree.segments)
    assert cuts > 2
    for frame in range(12 + 4 * cuts):
        nearer = 4 * (PLATE_PER_M * max(0.0, 1 - 0.2 * frame),)
        tree = live.segment(plates(*PLATES, frame=frame, nearer_per_m=nearer), Budget(judged_pixels=0))
        assert live.report.judged <= 1
    assert len(tree.segments) == 1
    assert [node.name for node in depth_first(live._root)] == [""]


def test_a_protrusion_is_given_back_where_its_parent_took_the_place_of_another() -> None:
    root, features = halves(plates(DOOR), (20, 30, 40), Division.PROTRUSION)
    # Beside the rest two parts: the door, of which a half is a protrusion of the other half, and more wall.
    wall, others = root.children
    half, door = others.children
    other_half, more_wall = door.children
    others.children, others.division = (door, more_wall), Division.GAP
    door.children = (half, other_half)
    for node in depth_first(root):
        for number, child in enumerate(node.children):
            child.name = f"{node.name}{number}"
    assert undo_protrusions(root, features, CONFIG) == 2
    assert [leaf.grid_pixels.size for leaf in leaves_below(root)] == [60 * 60, 20 * 60]
    assert [leaf.memory for leaf in leaves_below(root)] == [wall.memory, half.memory]
