import json
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from nurbseg.app.errors import ExportError
from nurbseg.app.export.exporter import Exporter
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.app.export.tree import surfaces_npz, tree_document
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.common.errors import BackendMissingError
from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.library.palette import label_color
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import DepthConfig, ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.segments import SegmentationTree, Trial
from nurbseg.segmentation.surfaces.surface import evaluate


@pytest.fixture(scope="module", params=["surfaces", "objects"])
def merged_result(request: pytest.FixtureRequest, small_result: FrameResult) -> FrameResult:
    """A frame segmented by the method that merges surfaces into objects, at either level."""
    return process_frame(
        small_result.frame, SegmentationConfig(method="nurbseg", extended=ExtendedConfig(level=request.param))
    )


SETTINGS = RunSettings(SegmentationConfig(method="stag15"), surfaces=True)


def exported(result: FrameResult, folder: Path, *, surfaces: bool = True) -> None:
    Exporter(folder, replace(SETTINGS, surfaces=surfaces)).write(result)


def test_files_are_named_by_the_frames_number(small_result: FrameResult, tmp_path: Path) -> None:
    result = replace(small_result, frame=replace(small_result.frame, index=42))
    exported(result, tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [
        "000042_labels.png",
        "000042_surfaces.npz",
        "000042_tree.json",
        "settings.json",
    ]


def test_objects_and_a_preview_are_written_when_requested(small_result: FrameResult, tmp_path: Path) -> None:
    Exporter(tmp_path, SETTINGS, ExportConfig(objects=True, preview=True)).write(small_result)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"000000_objects.json", "000000_preview.png", "objects.csv"} <= names


def test_files_may_keep_the_name_that_the_frame_has_in_its_source(
    small_result: FrameResult, tmp_path: Path
) -> None:
    config = ExportConfig(names="source")
    for name in ("Kueche 1/IMG_0042", ""):
        frame = replace(small_result.frame, index=42, name=name)
        Exporter(tmp_path, SETTINGS, config).write(replace(small_result, frame=frame))
    trees = sorted(path.name for path in tmp_path.glob("*_tree.json"))
    assert trees == ["000042_tree.json", "Kueche_1_IMG_0042_tree.json"]


@pytest.mark.parametrize("force", [False, True])
def test_a_frame_never_replaces_another_one_of_its_run(
    small_result: FrameResult, tmp_path: Path, force: bool
) -> None:
    exporter = Exporter(tmp_path, SETTINGS, ExportConfig(names="source", force=force))
    first, second = (
        replace(small_result, frame=replace(small_result.frame, index=index, name=name))
        for index, name in enumerate(("IMG 1", "IMG_1"))
    )
    exporter.write(first)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ExportError, match=r"IMG_1_tree\.json: another frame .* --export-names number"):
        exporter.write(second)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert exporter.written == 1


def test_what_exists_is_replaced_only_by_force(small_result: FrameResult, tmp_path: Path) -> None:
    exported(small_result, tmp_path)
    results = [path for path in tmp_path.iterdir() if path.name[0].isdigit()]
    for path in results:
        path.write_text("mine")
    with pytest.raises(ExportError, match=r"000000_labels\.png: already exists; .* with --force"):
        exported(small_result, tmp_path)
    assert [path.read_text() for path in results] == ["mine"] * len(results)
    Exporter(tmp_path, SETTINGS, ExportConfig(force=True)).write(small_result)
    assert b"mine" not in {path.read_bytes() for path in results}


def test_the_preview_is_the_frame_with_its_objects_outlined_in_their_colors(
    small_result: FrameResult, tmp_path: Path
) -> None:
    Exporter(tmp_path, SETTINGS, ExportConfig(preview=True)).write(small_result)
    preview = cv2.imread(str(tmp_path / "000000_preview.png"))[..., ::-1]
    labels = small_result.labels("objects")
    sizes = {label: np.count_nonzero(labels == label) for label in range(1, int(labels.max()) + 1)}
    outlined = sorted(sizes, key=sizes.__getitem__)[:-1]
    assert len(outlined) > 2
    edges = np.zeros_like(labels)
    for label in outlined:
        edges[(labels == label) & ~np.asarray(binary_erosion(labels == label))] = label
    colors = np.array([label_color(label) for label in edges[edges > 0].tolist()])
    # In a small image, numbers cover some of them.
    assert np.mean(np.all(preview[edges > 0] == colors, axis=1)) > 0.5
    assert np.mean(np.all(preview == small_result.cloud.color, axis=2)) > 0.5


def test_a_missing_library_is_named_with_the_extra_that_brings_it(
    small_result: FrameResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nurbseg.library.models.forms.find_spec", lambda name: None)
    text = r"step: needs OCP.*nurbseg\[step\]"
    with pytest.raises(ExportError, match=f"--export-cad {text}"):
        Exporter(tmp_path / "out", SETTINGS, ExportConfig(cad="step"))
    with pytest.raises(BackendMissingError, match=text):
        small_result.export(tmp_path / "a.step")
    assert not (tmp_path / "out").exists()


def test_surfaces_are_written_only_when_requested(small_result: FrameResult, tmp_path: Path) -> None:
    exported(small_result, tmp_path, surfaces=False)
    assert not list(tmp_path.glob("*.npz"))


def test_the_tree_file_agrees_with_itself_and_with_the_labels(
    small_result: FrameResult, tmp_path: Path
) -> None:
    exported(small_result, tmp_path)
    document = json.loads((tmp_path / "000000_tree.json").read_text())
    labels = cv2.imread(str(tmp_path / "000000_labels.png"), cv2.IMREAD_UNCHANGED)
    assert (document["height"], document["width"]) == labels.shape
    segments = {segment["name"]: segment for segment in document["segments"]}
    assert len(segments) == len(small_result.tree.segments) > 2
    assert segments["P"]["parent"] is None
    assert segments["P"]["size"] == np.count_nonzero(labels)
    for name, segment in segments.items():
        assert segment["depth"] == len(name) - 1
        if segment["children"]:
            assert segment["label"] is None
            assert segment["stop"] is None
            assert segment["size"] == sum(segments[child]["size"] for child in segment["children"])
            assert {segments[child]["parent"] for child in segment["children"]} == {name}
        else:
            assert np.unique(labels.ravel()[small_result.tree[name[1:]].pixels]).tolist() == [
                segment["label"]
            ]
            assert segment["stop"]
        assert segment["value"] == segment["values"]["mse"]


def test_both_levels_are_exported_and_each_leaf_names_its_object(
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
    for leaf in (segment for segment in document["segments"] if not segment["children"]):
        pixels = tree[leaf["name"][1:]].pixels
        for name, key in (("labels", "label"), ("surfaces", "leaf"), ("objects", "object")):
            assert np.unique(images[name].ravel()[pixels]).tolist() == [leaf[key]]
        assert leaf["name"] in document["objects"][leaf["object"] - 1]["leaves"]
    assert len(document["contacts"]) == len(tree.contacts)
    assert all(contact["merged"] or contact["reason"] for contact in document["contacts"])
    names = ["first", "second", "merged", "samples", "log_odds", "evidence", "reason"]
    assert all(list(contact) == names for contact in document["contacts"])


def test_the_evaluator_of_the_page_on_files_gives_the_points(
    merged_result: FrameResult, small_result: FrameResult, tmp_path: Path
) -> None:
    page = (Path(__file__).parents[3] / "docs/files.md").read_text()
    (program,) = re.findall(r"<!-- run by the tests: evaluator -->\n```python\n(.*?)```", page, re.DOTALL)
    scope: dict[str, Any] = {}
    exec(program, scope)
    for number, result in enumerate((merged_result, small_result)):
        path = tmp_path / f"{number}.npz"
        path.write_bytes(surfaces_npz(result.tree))
        leaves = [leaf for leaf in result.tree.leaves() if leaf.fit.surface is not None]
        assert len(leaves) > 3
        for leaf in leaves:
            v, u = np.divmod(leaf.fit.pixels[:: max(1, leaf.fit.pixels.size // 9)], result.tree.shape[1])
            assert leaf.fit.surface is not None
            expected = evaluate(leaf.fit.surface, u, v)
            assert np.allclose(scope["evaluate"](path, f"P{leaf.name}", u, v), expected, atol=1e-9)


def test_the_surfaces_file_gives_the_measured_pixels_back(merged_result: FrameResult, tmp_path: Path) -> None:
    exported(merged_result, tmp_path)
    with np.load(tmp_path / "000000_surfaces.npz") as arrays:
        for segment in merged_result.tree.segments:
            measured = np.cumsum(arrays[f"P{segment.name}_measured"])
            assert measured.size > 0
            assert np.array_equal(measured, segment.fit.pixels)


def test_the_settings_are_written_next_to_the_frames(small_result: FrameResult, tmp_path: Path) -> None:
    config = SegmentationConfig(metric="vgc", splits_max=7)
    settings = RunSettings(config, source="kitchen.mcap", temporal=True, target_fps=30.0)
    Exporter(tmp_path, settings).write(small_result)
    found = json.loads((tmp_path / "settings.json").read_text())
    assert (found["source"], found["temporal"], found["target_fps"]) == ("kitchen.mcap", True, 30.0)
    assert found["segmentation"] == asdict(config)
    assert found.keys() == {
        *("source", "temporal", "target_fps", "surfaces", "depth", "camera", "depth_scale", "segmentation"),
        *("computer", "trials_max"),
    }
    assert found["segmentation"]["extended"]["cuts"] == 3
    assert json.loads((tmp_path / "000000_tree.json").read_text())["metric"] == "vgc"


def test_a_folder_takes_further_results_of_the_same_settings(
    small_result: FrameResult, tmp_path: Path
) -> None:
    settings = RunSettings(
        SegmentationConfig(),
        depth=DepthConfig(crop=(1, 2, 30, 40)),
        camera=small_result.frame.calibration,
    )
    for _ in range(2):
        Exporter(tmp_path, settings, ExportConfig(force=True)).write(small_result)


STAG15 = SegmentationConfig(method="stag15")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"config": replace(STAG15, ratio_max=0.5)}, r"segmentation\.ratio_max is 1\.0 there and 0\.5 now"),
        (
            *({"camera": Calibration.registered(Intrinsics(160, 120, 77.0, 131.0, 79.5, 59.5))},),
            r"camera\.depth\.fx is [\d.]+ there and 77\.0 now",
        ),
    ],
)
def test_results_of_other_settings_and_cameras_are_not_mixed(
    small_result: FrameResult, tmp_path: Path, changes: dict[str, Any], text: str
) -> None:
    settings = RunSettings(STAG15, surfaces=True, camera=small_result.frame.calibration)
    Exporter(tmp_path, settings).write(small_result)
    with pytest.raises(ExportError, match=rf"settings\.json: .* {text}.*; export to"):
        Exporter(tmp_path, replace(settings, **changes))
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(ExportError, match=r"settings\.json: cannot be read"):
        Exporter(tmp_path, settings)
    (tmp_path / "settings.json").unlink()
    with pytest.raises(ExportError, match=r"holds results without settings\.json"):
        Exporter(tmp_path, settings)


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
    with pytest.raises(
        ExportError, match=r"000001_labels\.png: cannot be written: .*; the 1 previous frames"
    ):
        exporter.write(following)
    assert not [path for path in tmp_path.iterdir() if path.name.endswith(".part")]


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ExportError, match="file/out: cannot be created: Not a directory"):
        Exporter(tmp_path / "file" / "out", SETTINGS)


def test_the_same_tree_gives_the_same_bytes(small_result: FrameResult) -> None:
    assert surfaces_npz(small_result.tree) == surfaces_npz(small_result.tree)
