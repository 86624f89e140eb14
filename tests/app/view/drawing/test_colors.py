"""One object has one color wherever it is seen."""

from __future__ import annotations

import colorsys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nurbseg.app.live.opening import demo_uri
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.frame import TreeNode, ViewFrame, object_table
from nurbseg.app.view.drawing.tree import folded_by_object
from nurbseg.app.view.opening import open_view
from nurbseg.drivers.registry import open_source
from nurbseg.library.palette import label_color
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import SegmentationConfig
from tests.fakes.saved_view import SavedView, read_saved_view

Color = tuple[int, int, int]


@pytest.fixture(scope="module")
def result() -> FrameResult:
    with open_source(demo_uri()) as source:
        frame = source.read()
    # A third region of the ground truth, in which nothing is found.
    labels = np.zeros(frame.depth_mm.shape, dtype=np.uint16)
    labels[frame.depth_mm > 0] = 7
    labels[frame.depth_mm == 0] = 9
    result = process_frame(frame, SegmentationConfig())
    box = result.object_labels[int(np.argmax([len(each.leaves) for each in result.tree.objects]))]
    labels[result.labels("objects") == box] = 8
    return replace(result, frame=replace(frame, labels=labels))


@pytest.fixture(scope="module")
def saved(result: FrameResult, tmp_path_factory: pytest.TempPathFactory) -> SavedView:
    path: Path = tmp_path_factory.mktemp("colors") / "a.rrd"
    with open_view(ViewConfig(mode="none", save=str(path)), SegmentationConfig()) as view:
        view.show(result)
    return read_saved_view(path)


def component(saved: SavedView, path: str, name: str) -> object:
    (value,) = saved.by_frame[path][name].values()
    return value


def class_colors(saved: SavedView, path: str) -> dict[int, Color]:
    """Return the colors of the nearest annotation, at the path or above."""
    annotated = [each for each in saved.static if "AnnotationContext:context" in saved.static[each]]
    nearest = max((each for each in annotated if path.startswith(each)), key=len)
    rows = saved.static[nearest]["AnnotationContext:context"][0]
    return {row["class_id"]: unpacked(row["class_description"]["info"]["color"]) for row in rows}


def unpacked(rgba: int) -> Color:
    return rgba >> 24, rgba >> 16 & 255, rgba >> 8 & 255


def hue(color: Color) -> float:
    return colorsys.rgb_to_hsv(*(each / 255 for each in color))[0]


def picture_colors(saved: SavedView, path: str, mask: NDArray[np.bool_]) -> set[Color]:
    buffer = component(saved, path, "SegmentationImage:buffer")[0]  # type: ignore[index]
    labels = np.frombuffer(bytes(buffer), np.uint16).reshape(mask.shape)
    colors = class_colors(saved, path)
    return {colors[label] for label in np.unique(labels[mask]).tolist()}


def test_pictures_surfaces_points_and_tree_agree(result: FrameResult, saved: SavedView) -> None:
    objects, surfaces = result.labels("objects"), result.labels("surfaces")
    assert max(len(each.leaves) for each in result.tree.objects) > 2
    colors = class_colors(saved, "world/camera/image/objects")
    names = component(saved, "tree", "GraphNodes:labels")
    fills = component(saved, "tree", "GraphNodes:colors")
    dots = dict(zip(names, map(unpacked, fills), strict=True))  # type: ignore[call-overload]
    vertices = np.array(component(saved, "world/surfaces", "Mesh3D:vertex_positions"))
    camera = result.frame.calibration.depth
    u = np.rint(camera.fx * vertices[:, 0] / vertices[:, 2] + camera.cx).astype(int)
    v = np.rint(camera.fy * vertices[:, 1] / vertices[:, 2] + camera.cy).astype(int)
    height, width = objects.shape
    at = v.clip(0, height - 1), u.clip(0, width - 1)
    tints = [unpacked(each) for each in component(saved, "world/surfaces", "Mesh3D:vertex_colors")]  # type: ignore[attr-defined]
    points = component(saved, "world/points", "Points3D:class_ids")
    assert {class_colors(saved, "world/points")[point] for point in set(points)} <= set(colors.values())  # type: ignore[call-overload]
    for label in result.object_labels:
        mask = objects == label
        assert picture_colors(saved, "world/camera/image/objects", mask) == {colors[label]}
        own = np.unique(surfaces[mask]).tolist()
        shades = picture_colors(saved, "world/camera/image/surfaces", mask)
        assert colors[label] in shades
        assert len(shades) == min(len(own), 7)
        assert {dots[f"label {each}"] for each in own} == shades
        # Not at its border, where a vertex may lie in a pixel of the neighbor.
        inside = cv2.erode(mask.astype(np.uint8), np.ones((9, 9), np.uint8))[at] > 0
        assert {tints[each] for each in np.flatnonzero(inside)} <= shades
        assert all(abs(hue(shade) - hue(colors[label])) < 0.02 for shade in shades)


def test_outlines_are_those_of_objects_in_their_colors(result: FrameResult, saved: SavedView) -> None:
    objects = result.labels("objects")
    assert class_colors(saved, "world/camera/outlines") == class_colors(saved, "world/camera/image/objects")
    labels = component(saved, "world/camera/outlines", "LineStrips2D:class_ids")
    strips = component(saved, "world/camera/outlines", "LineStrips2D:strips")
    for label, strip in zip(labels, strips, strict=True):  # type: ignore[call-overload]
        columns, rows = np.floor(np.array(strip)).astype(int).T
        assert (objects[rows, columns] == label).all()
    largest = np.bincount(objects[objects > 0]).argmax()
    assert {*labels} <= {*np.unique(objects[objects > 0]).tolist()} - {largest}  # type: ignore[misc]
    assert len({*labels}) > 5  # type: ignore[misc]


def test_ground_truth_has_the_color_of_what_overlaps_it_most(result: FrameResult, saved: SavedView) -> None:
    truth = result.frame.labels
    assert truth is not None
    objects = result.labels("objects")
    path = "world/camera/ground_truth"
    colors = class_colors(saved, "world/camera/image/objects")
    for region in (7, 8):
        labels, counts = np.unique(objects[(truth == region) & (objects > 0)], return_counts=True)
        assert picture_colors(saved, path, truth == region) == {colors[int(labels[counts.argmax()])]}
    assert picture_colors(saved, path, truth == 9) == {(128, 128, 128)}


def node(name: str, thing: int | None = None, *, children: tuple[str, ...] = ()) -> TreeNode:
    label = None if children else 1
    return TreeNode(name, children, label, thing, 10, None, None, None, None, True, None, None)


def test_a_part_of_the_tree_within_one_object_is_one_node() -> None:
    nodes = [
        node("", children=("0", "1")),
        node("0", children=("00", "01")),
        node("00", 4),
        node("01", children=("010", "011")),
        node("010", 4),
        node("011", 4),
        node("1", children=("10", "11")),
        node("10", 4),
        node("11", 5),
    ]
    folded = folded_by_object(nodes)
    assert [(segment.name, segment.children, segment.thing) for segment in folded] == [
        ("", ("0", "1"), None),
        ("0", (), 4),
        ("1", ("10", "11"), None),
        ("10", (), 4),
        ("11", (), 5),
    ]


@pytest.fixture(scope="module")
def frame(result: FrameResult) -> ViewFrame:
    return drawn(result, ViewConfig(), "mse")


def test_boxes_are_drawn_with_the_numbers_and_sizes_of_the_table(
    result: FrameResult, frame: ViewFrame, saved: SavedView
) -> None:
    labels = component(saved, "world/boxes", "Boxes3D:labels")
    halves = np.array(component(saved, "world/boxes", "Boxes3D:half_sizes"))
    centers = np.array(component(saved, "world/boxes", "Boxes3D:centers"))
    turns = np.array(component(saved, "world/boxes", "Boxes3D:quaternions"))
    assert len(labels) == len(result.objects)  # type: ignore[arg-type]
    rows = {
        line.split("|")[1].strip(): line.split("|")[4].strip()
        for line in object_table(frame).splitlines()[4:]
        if line.startswith("| ")
    }
    for n, each in enumerate(result.objects):
        number, _, size = labels[n].partition("  ")  # type: ignore[index]
        assert number.rstrip("?") == str(each.label) and (number[-1] != "?") == each.is_sure
        # In space, only what is sure has its size beside the number.
        assert size == (f"{rows[number]} cm" if each.is_sure else "")
        np.testing.assert_allclose(2 * halves[n], each.box.size_m, atol=1e-6)
        np.testing.assert_allclose(centers[n], each.box.center_m, atol=1e-6)
        np.testing.assert_allclose(Rotation.from_quat(turns[n]).as_matrix(), each.box.axes.T, atol=1e-6)


def test_numbers_on_the_photo_are_where_boxes_are(result: FrameResult, saved: SavedView) -> None:
    places = np.array(component(saved, "world/camera/numbers", "Points2D:positions"))
    camera = result.frame.calibration.depth
    for each, place in zip(result.objects, places, strict=True):
        x, y, z = each.box.center_m
        assert place == pytest.approx(
            (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), abs=1e-2
        )
    # Paler than the outlines, to be read on any photo.
    packed = np.array(component(saved, "world/camera/numbers", "Points2D:colors"))
    for each, color in zip(result.objects, packed, strict=True):
        rgb = [int(color) >> shift & 255 for shift in (24, 16, 8)]
        np.testing.assert_allclose(rgb, (np.array(label_color(each.label)) + 255) / 2, atol=1.5)


def test_points_have_their_own_colors_beside_those_of_objects(frame: ViewFrame) -> None:
    assert frame.point_colors.shape == frame.points_m.shape
    rays = frame.points_m / frame.points_m[:, 2:]
    camera = frame.calibration.depth
    u, v = (
        np.rint(rays[:, n] * f + c).astype(int)
        for n, f, c in ((0, camera.fx, camera.cx), (1, camera.fy, camera.cy))
    )
    np.testing.assert_array_equal(frame.point_colors, frame.color[v, u])


def test_objects_are_listed_by_distance_with_size_and_error(result: FrameResult, saved: SavedView) -> None:
    text = component(saved, "objects", "TextDocument:text")[0]  # type: ignore[index]
    table, _, _ = text.partition("\n\nMerged surfaces:\n")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[4:]]
    measured = {each.label: each for each in result.objects}
    assert {int(row[0].rstrip("?")) for row in rows} == set(measured)
    distances = [float(row[2]) for row in rows]
    assert distances == sorted(distances)
    for row in rows:
        each = measured[int(row[0].rstrip("?"))]
        assert float(row[2]) == pytest.approx(np.linalg.norm(each.centroid_m), abs=0.006)
        assert int(row[5].replace(",", "")) == each.pixels.size
        assert int(row[6]) == len(each.leaves)
