import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from nurbseg.app.atomic_file import write_atomically
from nurbseg.app.export.exporter import Exporter, ExportError, run_settings
from nurbseg.app.export.surfaces import surfaces_npz
from nurbseg.app.export.tree import tree_document
from nurbseg.app.live.tracking import process_frame
from nurbseg.app.result import FrameResult
from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.segments import SegmentationTree, Trial
from nurbseg.segmentation.surfaces.surface import NurbsSurface, evaluate


@pytest.fixture(scope="module", params=["surfaces", "objects"])
def merged_result(request: pytest.FixtureRequest, small_result: FrameResult) -> FrameResult:
    """A frame segmented by the method that merges surfaces into objects, at either level."""
    return process_frame(
        small_result.frame, SegmentationConfig(method="nurbseg", extended=ExtendedConfig(level=request.param))
    )


SETTINGS = run_settings(SegmentationConfig(method="stag15"), surfaces=True)


def exported(result: FrameResult, folder: Path, *, surfaces: bool = True) -> None:
    Exporter(folder, {**SETTINGS, "surfaces": surfaces}).write(result)


def test_files_are_named_by_the_frames_number(small_result: FrameResult, tmp_path: Path) -> None:
    result = replace(small_result, frame=replace(small_result.frame, index=42))
    exported(result, tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["000042_labels.png", "000042_surfaces.npz", "000042_tree.json", "settings.json"]


def test_surfaces_are_written_only_when_asked_for(small_result: FrameResult, tmp_path: Path) -> None:
    exported(small_result, tmp_path, surfaces=False)
    assert not list(tmp_path.glob("*.npz"))


def test_the_labels_file_is_the_label_image(small_result: FrameResult, tmp_path: Path) -> None:
    exported(small_result, tmp_path)
    labels = cv2.imread(str(tmp_path / "000000_labels.png"), cv2.IMREAD_UNCHANGED)
    assert labels.dtype == np.uint16
    assert np.array_equal(labels, small_result.tree.labels())


def test_the_tree_file_agrees_with_itself_and_with_the_labels(
    small_result: FrameResult, tmp_path: Path
) -> None:
    exported(small_result, tmp_path)
    document = json.loads((tmp_path / "000000_tree.json").read_text())
    labels = cv2.imread(str(tmp_path / "000000_labels.png"), cv2.IMREAD_UNCHANGED)
    assert (document["height"], document["width"]) == labels.shape
    segments = {each["name"]: each for each in document["segments"]}
    assert len(segments) == len(small_result.tree.segments) > 2
    assert segments["P"]["parent"] is None
    assert segments["P"]["size"] == np.count_nonzero(labels)
    for name, each in segments.items():
        assert each["depth"] == len(name) - 1
        if each["children"]:
            assert each["label"] is None
            assert each["stop"] is None
            assert each["size"] == sum(segments[child]["size"] for child in each["children"])
            assert {segments[child]["parent"] for child in each["children"]} == {name}
        else:
            assert np.unique(labels.ravel()[small_result.tree[name[1:]].pixels]).tolist() == [each["label"]]
            assert each["stop"]
        assert each["value"] == each["values"]["mse"]


def test_both_levels_are_exported_and_each_leaf_tells_its_object(
    merged_result: FrameResult, tmp_path: Path
) -> None:
    exported(merged_result, tmp_path)
    tree = merged_result.tree
    images = {
        name: cv2.imread(str(tmp_path / f"000000_{name}.png"), cv2.IMREAD_UNCHANGED)
        for name in ("labels", "surfaces", "objects")
    }
    assert np.array_equal(images["labels"], images[tree.level])
    document = json.loads((tmp_path / "000000_tree.json").read_text())
    assert document["level"] == tree.level
    for leaf in (each for each in document["segments"] if not each["children"]):
        pixels = tree[leaf["name"][1:]].pixels
        for name, key in (("labels", "label"), ("surfaces", "leaf"), ("objects", "object")):
            assert np.unique(images[name].ravel()[pixels]).tolist() == [leaf[key]]
        assert leaf["name"] in document["objects"][leaf["object"] - 1]["leaves"]
    assert len(document["contacts"]) == len(tree.contacts)
    assert all(each["merged"] or each["reason"] for each in document["contacts"])


def test_the_surfaces_file_gives_the_surfaces_back(small_result: FrameResult, tmp_path: Path) -> None:
    exported(small_result, tmp_path)
    with np.load(tmp_path / "000000_surfaces.npz") as arrays:
        names = arrays["names"].tolist()
        assert len(names) == sum(each.fit.surface is not None for each in small_result.tree.segments) > 0
        for at, name in enumerate(names):
            original = small_result.tree[name.removeprefix("P")].fit.surface
            assert original is not None
            surface = NurbsSurface(
                degree=tuple(arrays["degree"][at].tolist()),
                knots_u=arrays[f"{name}_knots_u"],
                knots_v=arrays[f"{name}_knots_v"],
                control_points_m=arrays[f"{name}_control_points_m"],
                weights=arrays[f"{name}_weights"],
                window=tuple(arrays["window"][at].tolist()),
            )
            top, left, bottom, right = surface.window
            u, v = np.linspace(left, right - 1, 7), np.linspace(top, bottom - 1, 7)
            assert np.array_equal(evaluate(surface, u, v), evaluate(original, u, v))


def test_the_surfaces_file_gives_the_measured_pixels_back(merged_result: FrameResult, tmp_path: Path) -> None:
    exported(merged_result, tmp_path)
    with np.load(tmp_path / "000000_surfaces.npz") as arrays:
        for each in merged_result.tree.segments:
            measured = np.cumsum(arrays[f"P{each.name}_measured"])
            assert measured.size > 0
            assert np.array_equal(measured, each.fit.pixels)


def test_the_settings_are_written_beside_the_frames(small_result: FrameResult, tmp_path: Path) -> None:
    config = SegmentationConfig(metric="vgc", splits_max=7)
    settings = run_settings(config, source="kitchen.mcap", temporal=True, target_fps=30.0)
    Exporter(tmp_path, settings).write(small_result)
    found = json.loads((tmp_path / "settings.json").read_text())
    assert (found["source"], found["temporal"], found["target_fps"]) == ("kitchen.mcap", True, 30.0)
    assert found["segmentation"] == asdict(config)
    assert found["segmentation"]["extended"]["cuts"] == 3
    assert json.loads((tmp_path / "000000_tree.json").read_text())["metric"] == "vgc"


def test_results_of_other_settings_are_not_mixed(small_result: FrameResult, tmp_path: Path) -> None:
    exported(small_result, tmp_path)
    exported(small_result, tmp_path)
    other = run_settings(SegmentationConfig(method="stag15", ratio_max=0.5))
    with pytest.raises(
        ExportError, match=r"settings\.json: .* ratio_max is 1\.0 there and 0\.5 now; export to"
    ):
        Exporter(tmp_path, other)
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(ExportError, match=r"settings\.json: cannot be read"):
        Exporter(tmp_path, SETTINGS)
    (tmp_path / "settings.json").unlink()
    with pytest.raises(ExportError, match=r"holds results without settings\.json"):
        Exporter(tmp_path, SETTINGS)


def test_a_frame_without_a_point_is_exported_too(
    small_result: FrameResult, empty_result: Callable[[FrameResult], FrameResult], tmp_path: Path
) -> None:
    exported(empty_result(small_result), tmp_path)
    document = json.loads((tmp_path / "000000_tree.json").read_text())
    (root,) = document["segments"]
    assert (root["size"], root["stop"], root["surface"]) == (0, "no-points", False)
    assert root["reason"]
    labels = cv2.imread(str(tmp_path / "000000_labels.png"), cv2.IMREAD_UNCHANGED)
    assert not labels.any()
    with np.load(tmp_path / "000000_surfaces.npz") as arrays:
        assert arrays["names"].size == 0


@pytest.fixture
def empty_result() -> Callable[[FrameResult], FrameResult]:
    def make(result: FrameResult) -> FrameResult:
        frame = replace(result.frame, depth_mm=np.zeros_like(result.frame.depth_mm), labels=None)
        return process_frame(frame, SegmentationConfig(method="stag15"))

    return make


def test_infinite_values_become_null(small_result: FrameResult) -> None:
    segments = list(small_result.tree.segments)
    segments[0] = replace(segments[0], trial=Trial("mse", 0.0, 9, ((0.0, 4), (0.0, 5)), kept=False))
    result = replace(small_result, tree=SegmentationTree(tuple(segments), small_result.tree.shape))
    document = tree_document(result, "mse")
    assert document["segments"][0]["ratio"] is None
    json.dumps(document, allow_nan=False)


def test_a_file_that_cannot_be_written_ends_with_what_is_kept(
    small_result: FrameResult, tmp_path: Path
) -> None:
    exporter = Exporter(tmp_path, SETTINGS)
    exporter.write(small_result)
    following = replace(small_result, frame=replace(small_result.frame, index=1))
    (tmp_path / "000001_labels.png").mkdir()
    with pytest.raises(ExportError, match=r"000001_labels\.png: cannot be written: .*; the 1 frames before"):
        exporter.write(following)
    assert not [path for path in tmp_path.iterdir() if path.name.endswith(".part")]


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ExportError, match="file/out: cannot be made: Not a directory"):
        Exporter(tmp_path / "file" / "out", SETTINGS)


def test_an_interrupted_write_leaves_the_old_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.json"
    write_atomically(path, b"old")

    def interrupted(self: Path, target: Path) -> Path:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_same_tree_gives_the_same_bytes(small_result: FrameResult) -> None:
    assert surfaces_npz(small_result.tree) == surfaces_npz(small_result.tree)
