"""The check finds nothing wrong with what was exported, and whatever is made wrong with it."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import rendered
from scipy.interpolate import BSpline
from small_scene import small_frame

from nurbseg.app.batch.batch_command import main as batch
from nurbseg.app.export.exporter import Exporter
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.common.errors import RecordingFormatError
from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers.calibration.file import write_calibration
from nurbseg.drivers.mcap.reader import RecordingReader
from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.check.check import FolderCheck
from nurbseg.evaluation.eval_command import main
from nurbseg.library.segmenter import Segmenter, process_frame
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import register

RECORDING = rendered("width=160&height=120&frames=2")
GUIDE = Path(__file__).parents[3] / "docs/files.md"
ALL = pytest.mark.parametrize(
    "name", ["stag15", "curvature", "counts", "nurbseg", "strict", "no floor", "surfaces"]
)
BOTH = pytest.mark.parametrize("name", ["stag15", "nurbseg"])


@ALL
def test_nothing_is_found_in_what_was_exported(export, name):
    assert export(name).findings(RECORDING) == []


def test_nothing_is_found_in_an_image_whose_grid_has_another_step(tmp_path):
    recording = rendered("width=848&height=480&frames=1")
    words = ["--replay", recording, "--view", "none", "--export", str(tmp_path / "out"), "--export-surfaces"]
    subprocess.run([Path(sys.executable).with_name("nurbseg-live"), *words], check=True, timeout=300)
    assert main(["check", str(tmp_path / "out"), "--frames", recording]) == 0


def test_the_exports_hold_all_that_is_damaged_below(export):
    reasons, kept = set(), set()
    for name in ("stag15", "counts", "nurbseg", "strict"):
        for segment in (*export(name).segments().values(), *export(name).segments(frame=1).values()):
            reasons.add(segment["stop"])
            kept.add((name, segment["division"], segment["trial"] and segment["trial"]["kept"]))
    assert reasons >= {None, "criterion", "child-too-small", "too-small", "depth", "splits", "noise"}
    assert kept >= {
        ("stag15", "cut", True),
        ("stag15", None, False),
        ("nurbseg", "gap", None),
        ("strict", None, False),
    }


def test_nothing_is_found_in_files_that_are_named_as_in_their_source(tmp_path):
    recording = rendered("width=160&height=120&frames=4")
    config = SegmentationConfig()
    settings = RunSettings(config, source=recording, temporal=True, surfaces=True)
    exporter = Exporter(tmp_path, settings, ExportConfig(names="source"))
    segmenter = Segmenter(config, every_surface=True)
    with open_source(recording) as source:
        for frame in source:
            exporter.write(segmenter.process(replace(frame, name=f"IMG_{frame.index + 8}")))
    assert (tmp_path / "IMG_11_tree.json").exists()
    check = FolderCheck(tmp_path)
    assert [str(finding) for finding in check.findings()] == []
    assert (check.frames, check.unchecked) == (4, 0)


@pytest.mark.parametrize("method", ["stag15", "nurbseg"])
def test_nothing_is_found_in_a_real_frame_by_its_own_camera(real_data, tmp_path, capsys, method):
    recording = os.fspath(real_data("mosd_learn"))
    camera = (525.0, 525.0, 319.5, 239.5)
    config = SegmentationConfig(method=method)
    with open_source(recording, SourceOptions(intrinsics=camera)) as source:
        settings = RunSettings(config, surfaces=True, camera=source.calibration)
        Exporter(tmp_path, settings).write(process_frame(source.read(), config))
    words = ["check", os.fspath(tmp_path), "--frames", recording]
    assert main([*words, "--intrinsics", ",".join(map(str, camera))]) == 0
    capsys.readouterr()
    assert main([*words, "--intrinsics", "600,600,319.5,239.5"]) == 1
    [finding] = capsys.readouterr().out.splitlines()
    assert finding.startswith("settings.json: camera: expected that of the recording")
    assert "depth.fx is 525.0 there and 600.0 now, depth.fy is 525.0 there and 600.0 now, color.fx" in finding
    # Where no camera is named: seen by another one, these are other points.
    (tmp_path / "settings.json").write_text(json.dumps(replace(settings, camera=None).document()))
    assert main([*words, "--intrinsics", "600,600,319.5,239.5"]) == 1
    assert "_tree.json" in capsys.readouterr().out


def test_the_scale_of_depth_that_was_given_need_not_be_given_again(tmp_path, capsys):
    frame = small_frame()
    depth, color = (np.asarray(each) for each in (frame.depth_mm, frame.color))
    (tmp_path / "images").mkdir()
    cv2.imwrite(os.fspath(tmp_path / "images/a_depth.png"), 5 * depth)
    cv2.imwrite(os.fspath(tmp_path / "images/a_color.png"), color)
    write_calibration(tmp_path / "images/camera.toml", frame.calibration)
    images, out = os.fspath(tmp_path / "images"), os.fspath(tmp_path / "out")
    given = [images, "--depth-scale", "5000", "--export-surfaces"]
    words = ["--speed", "0", "--view", "none", "--splits-max", "2", "--export", out, "--replay", *given]
    subprocess.run([Path(sys.executable).with_name("nurbseg-live"), *words], check=True, timeout=120)
    words = ["--set", "splits_max=2", "--workers", "1", "--export", os.fspath(tmp_path / "b"), *given]
    assert batch(words) == 0
    assert main(["check", os.fspath(tmp_path / "b" / images.lstrip("/")), "--frames", images]) == 0
    assert main(["check", out, "--frames", images]) == 0
    assert main(["check", out, "--frames", images, "--depth-scale", "1000"]) == 1
    assert "1 frame with " in capsys.readouterr().err


def test_a_camera_that_was_recorded_is_the_same_but_for_rounding(tmp_path):
    turned = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0].round(4)
    transform = np.vstack([np.column_stack([turned, [-0.025, 0.0, 0.001]]), [0, 0, 0, 1]])
    depth = Intrinsics(160, 120, 131.1, 131.2, 79.3, 59.7, [0.01, -0.001, 0.0, 0.0])
    frame = small_frame(calibration=Calibration(depth, replace(depth, fx=120.1, distortion=[]), transform))
    recording = tmp_path / "one.mcap"
    with RecordingWriter(recording, frame.calibration, color_format="png") as writer:
        writer.write(frame)
    with open_source(str(recording)) as source:
        recorded = source.read()
    config = SegmentationConfig(splits_max=2)
    settings = RunSettings(config, surfaces=True, camera=frame.calibration)
    Exporter(tmp_path / "out", settings).write(process_frame(recorded, config))
    assert [str(finding) for finding in FolderCheck(tmp_path / "out", str(recording)).findings()] == []


def change(what, factor=1, add=0):
    """A change of one number of a segment."""
    return lambda each: each.update({what: each[what] * factor + add})


def swap_children(each):
    each["children"].reverse()


def value_and_values(each):
    each["values"]["mse"] = each["value"] = each["value"] * (1 + 1e-9)


def of_trial(change_trial):
    return lambda each: change_trial(each["trial"])


def first_part(what, by):
    def make(trial):
        trial["parts"][0][what] += by

    return of_trial(make)


#: What is changed of a cut, and the field that the finding names.
OF_A_CUT = {
    "ratio": (change("ratio", 1 + 1e-9), "ratio"),
    "no ratio": (lambda each: each.update(ratio=None), "ratio"),
    "value": (value_and_values, "ratio"),
    "value of the metric": (change("value", 1 + 1e-9), "value"),
    "size": (change("size", add=1), "size"),
    "points": (change("points", add=1), "points"),
    "depth": (change("depth", add=1), "depth"),
    "parent": (lambda each: each.update(parent="P"), "parent"),
    "order of children": (swap_children, "children"),
    "division": (lambda each: each.update(division="gap"), "division"),
    "no division": (lambda each: each.update(division=None), "division"),
    "stop": (lambda each: each.update(stop="criterion"), "stop"),
    "trial": (lambda each: each.update(trial=None), "trial"),
    "kept": (of_trial(lambda trial: trial.update(kept=False)), "trial"),
    "metric of the trial": (of_trial(lambda trial: trial.update(metric="mae")), "trial metric"),
    "value of a part": (first_part("value", 1e-9), "ratio"),
    "points of a part": (first_part("points", 1), "trial parts"),
    "label": (lambda each: each.update(label=3), "label"),
    "leaf": (lambda each: each.update(leaf=3), "leaf"),
    "surface": (lambda each: each.update(surface=False), "names"),
}


def a_split_that_was_never_made(each):
    each["trial"]["kept"], each["ratio"] = True, 0.0
    for part in each["trial"]["parts"]:
        part["value"] = 0.0


#: What is changed of a leaf whose split was rejected, and the field that the finding names.
OF_A_LEAF = {
    "size": (change("size", add=-1), "size"),
    "label": (change("label", add=1), "label"),
    "leaf": (change("leaf", add=1), "leaf"),
    "children": (lambda each: each.update(children=["P0", "P1"]), "children"),
    "division": (lambda each: each.update(division="cut"), "division"),
    "no stop": (lambda each: each.update(stop=None), "stop"),
    "ratio": (change("ratio", 1 - 1e-9), "ratio"),
    "trial": (lambda each: each.update(trial=None), "ratio"),
    "trial and ratio": (lambda each: each.update(trial=None, ratio=None), "stop"),
    "kept": (of_trial(lambda trial: trial.update(kept=True)), "trial"),
    "split": (a_split_that_was_never_made, "division"),
    "value before": (of_trial(change("value", 1.001)), "trial"),
    "points before": (of_trial(change("points", add=1)), "trial"),
    "points of parts": (first_part("points", -2000), "trial parts"),
    "reason": (lambda each: each.update(reason="none"), "reason"),
}


@pytest.mark.parametrize(
    ("name", "kind", "damage"),
    [(name, "cut", damage) for name in ("stag15", "nurbseg") for damage in OF_A_CUT]
    + [(name, "leaf", damage) for name in ("stag15", "strict") for damage in OF_A_LEAF],
)
def test_a_wrong_field_of_a_segment_is_found(export, name, kind, damage):
    folder = export(name)
    if kind == "cut":
        own = folder.first(lambda segment: segment["division"] == "cut" and len(segment["name"]) > 2)
    else:
        own = folder.first(lambda segment: segment["trial"] and not segment["children"])
    make, field = (OF_A_CUT if kind == "cut" else OF_A_LEAF)[damage]
    folder.tree(lambda segments: make(segments[own]))
    assert folder.finds(f": {'' if field == 'names' else f'{own} '}{field}: expected"), folder.findings()


#: Reasons that an export does not tell from each other.
ALIKE = {frozenset({"no-cut", "child-too-small"})}
REASONS = (
    *("criterion", "child-too-small", "too-small", "depth", "splits", "no-cut"),
    *("no-fit", "no-points", "noise", "budget", "pending"),
)


@pytest.mark.parametrize("name", ["stag15", "counts", "nurbseg", "strict", "hurried"])
def test_every_wrong_reason_to_stop_is_found(export, name):
    folder = export(name)
    folder.keep_first_tree_alone()
    leaf_of = {segment["stop"]: key for key, segment in folder.segments().items() if segment["stop"]}
    tried = 0
    for stop, leaf in leaf_of.items():
        for other in REASONS:
            if other == stop or frozenset({stop, other}) in ALIKE:
                continue
            folder.tree(lambda segments, leaf=leaf, other=other: segments[leaf].update(stop=other))
            assert folder.finds(f"000000_tree.json: {leaf} "), (leaf, other)
            folder.tree(lambda segments, leaf=leaf, stop=stop: segments[leaf].update(stop=stop))
            tried += 1
    assert tried >= 7
    assert folder.findings() == []


def test_what_cannot_have_stopped_a_live_tree_is_found(export):
    folder = export("nurbseg")
    folder.settings(temporal=True)
    leaf = folder.first(lambda segment: segment["stop"] == "criterion")
    assert folder.findings() == []
    for stop in ("noise", "no-points", "too-small", "depth", "no-fit", "budget", "pending", "unknown"):
        folder.tree(lambda segments, stop=stop: segments[leaf].update(stop=stop))
        expected = f"000000_tree.json: {leaf} stop: expected a reason that holds, found {stop}"
        assert expected in folder.findings()
    folder.tree(lambda segments: segments[leaf]["trial"].update(kept=True))
    assert folder.finds(f"000000_tree.json: {leaf} trial: expected one that was rejected")


def test_a_leaf_of_a_live_tree_waits_for_its_trial_unless_another_reason_holds(export):
    folder = export("strict")
    folder.settings(temporal=True)
    names = {segment["stop"]: name for name, segment in folder.segments().items() if segment["stop"]}
    waits = {"stop": "pending", "trial": None, "ratio": None}
    folder.tree(lambda segments: segments[names["criterion"]].update(waits))
    assert folder.findings() == []
    folder.tree(lambda segments: segments[names["noise"]].update(waits))
    expected = f"000000_tree.json: {names['noise']} stop: expected a reason that holds, found pending"
    assert folder.findings() == [expected]


def test_the_paper_splits_a_frame_without_large_errors_once(tmp_path):
    config = SegmentationConfig(method="stag15", metric="nle", large_error_m=10.0)
    exporter = Exporter(tmp_path, RunSettings(config, source=RECORDING, surfaces=True))
    with open_source(RECORDING) as source:
        result = process_frame(source.read(), config)
    exporter.write(result)
    assert (result.tree.root.fit.values["nle"], len(result.tree.segments)) == (0.0, 3)
    assert [str(finding) for finding in FolderCheck(tmp_path).findings()] == []


@pytest.mark.parametrize("side", range(4))
def test_a_window_without_one_row_or_column_of_its_segment_is_found(export, side):
    folder = export("nurbseg")
    image = cv2.imread(os.fspath(folder.folder / "000000_surfaces.png"), cv2.IMREAD_UNCHANGED)
    leaves = {
        key: segment["leaf"]
        for key, segment in folder.segments().items()
        if segment["leaf"] and segment["surface"]
    }

    def change(arrays):
        for name, window in zip(arrays["names"].tolist(), arrays["window"], strict=True):
            if name in leaves:
                rows, columns = np.nonzero(image == leaves[name])
                window[:] = rows.min(), columns.min(), rows.max() + 1, columns.max() + 1
                window[side] += 1 if side < 2 else -1

    folder.arrays(change)
    found = [finding.split()[1] for finding in folder.findings() if " window: expected to hold" in finding]
    assert found == list(leaves)


@pytest.mark.parametrize("label", [None, -1, 60000, 10**30])
def test_a_leaf_with_a_label_of_no_pixel_is_found(export, label):
    folder = export("nurbseg")
    leaf = folder.first(lambda segment: segment["leaf"] and segment["surface"])
    folder.tree(lambda segments: segments[leaf].update(leaf=label))
    assert folder.finds(f"000000_tree.json: {leaf} leaf: expected")


def test_no_points_are_the_reason_before_few(export):
    folder = export("nurbseg")
    leaf = folder.first(lambda segment: segment["stop"] == "too-small")
    folder.tree(lambda segments: segments[leaf].update(points=0))
    assert f"000000_tree.json: {leaf} stop: expected no-points, found too-small" in folder.findings()


def test_a_trial_of_a_protrusion_is_found(export):
    folder = export("strict")
    protrusion = folder.first(lambda segment: segment["division"] == "protrusion")
    tried = folder.first(lambda segment: segment["trial"])
    folder.tree(lambda segments: segments[protrusion].update(trial=segments[tried]["trial"]))
    assert folder.finds(f": {protrusion} trial: expected none of a protrusion")


@pytest.mark.parametrize("name", ["stag15", "nurbseg", "floored"])
def test_a_wrong_floor_is_found(export, name):
    folder = export(name)
    segment = folder.first(lambda segment: segment["surface"])
    floor = folder.segments()[segment]["floor"]
    assert (floor > 0) == (name != "stag15")
    for wrong in (0.999 * floor, 1.001 * floor) if floor else (1e-9,):
        folder.tree(lambda segments, wrong=wrong: segments[segment].update(floor=wrong))
        assert folder.finds(f": {segment} floor: expected", recording=RECORDING)


#: Settings under which an export could not have come about, and the field that the finding names.
OTHER_SETTINGS = {
    "stag15": [
        ("ratio_max", 1e-3, "trial"),
        ("depth_max", 2, "depth"),
        ("depth_max", 4, "stop"),
        ("splits_max", 1, "splits"),
        ("splits_max", 6, "stop"),
        ("segment_pixels_min", 20000, "trial parts"),
        ("metric", "mae", "metric"),
        ("decimation", 1, "points"),
        ("decimation", 4, "points"),
    ],
    "counts": [
        ("segment_pixels_min", 300, "stop"),
        ("segment_pixels_min", 1200, "trial parts"),
    ],
    # The first split was kept though it made its ratio larger, as only the paper's method does.
    "curvature": [("method", "nurbseg", "P trial")],
    "strict": [
        ("piece_pixels_min", 2, "stop"),
        ("piece_pixels_min", 4000, "points"),
        ("protrusion_min", 0.0, "division"),
    ],
    "hurried": [("budget_ms", 0.0, "stop"), ("splits_max", 2, "stop")],
    "nurbseg": [
        ("ratio_max", 1e-3, "trial"),
        ("depth_max", 2, "depth"),
        ("depth_max", 5, "stop"),
        ("splits_max", 3, "splits"),
        ("splits_max", 9, "stop"),
        ("piece_pixels_min", 4000, "trial parts"),
        ("method", "stag15", "division"),
        ("log_odds_min", 1e6, "merges merged"),
    ],
}


@pytest.mark.parametrize(
    ("name", "setting", "value", "field"),
    [(name, *setting) for name, settings in OTHER_SETTINGS.items() for setting in settings],
)
def test_other_settings_contradict_the_trees(export, name, setting, value, field):
    folder = export(name)
    folder.setting(setting, value)
    assert folder.finds(rf": (P[-P01]* )?{field}: expected"), folder.findings()


def paint(folder, file, change_image):
    path = folder.folder / file
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    change_image(image)
    cv2.imwrite(str(path), image)


def other_pixel(value):
    """A change of one labeled pixel to another label."""

    def change_image(image):
        row, column = np.argwhere((image != value) & (image > 0))[5]
        image[row, column] = value

    return change_image


@pytest.mark.parametrize("value", [0, 1, 60_000])
@pytest.mark.parametrize("file", ["labels", "surfaces", "objects"])
def test_one_wrong_pixel_is_found_in_each_image(export, file, value):
    folder = export("nurbseg")
    paint(folder, f"000000_{file}.png", other_pixel(value))
    assert folder.finds(f"000000_{'(labels|objects)' if file == 'surfaces' else file}.png: pixel")
    assert file != "surfaces" or folder.finds(" size: expected ")


@pytest.mark.parametrize("value", [0, 1, 60_000])
def test_one_wrong_pixel_is_found_where_labels_are_leaves(export, value):
    folder = export("stag15")
    paint(folder, "000001_labels.png", other_pixel(value))
    found = folder.findings()
    assert sum(" size: expected " in each for each in found) == (2 if value == 1 else 1), found
    assert folder.finds("label 60000: expected a leaf") == (value == 60_000)


def test_a_label_where_there_is_no_point_is_found(export):
    folder = export("stag15")
    with open_source(RECORDING) as source:
        row, column = np.argwhere(~register(source.read()).valid)[0]
    leaf = folder.segments()["P0"]
    while leaf["children"]:
        leaf = folder.segments()[leaf["children"][0]]

    def fill(image):
        image[row | 1, column] = leaf["leaf"]

    paint(folder, "000000_labels.png", fill)
    folder.tree(
        lambda segments: [
            segments[leaf["name"][:n]].update(size=segments[leaf["name"][:n]]["size"] + 1)
            for n in range(1, len(leaf["name"]) + 1)
        ]
    )
    assert folder.finds("no label, there is no point", recording=RECORDING)


def renamed_leaf(tree):
    leaf = next(segment for segment in tree["segments"] if segment["stop"])
    leaf["name"] += "1"


def likelier_merges(tree):
    for contact in tree["contacts"]:
        contact.update(evidence={"base": 9.0}, log_odds=9.0)


def one_sample_more(tree):
    tree["contacts"][0]["samples"] += 1


#: What is changed of a tree's lists, and what the findings say.
OF_A_TREE = {
    "order of segments": (
        lambda tree: tree["segments"].append(tree["segments"].pop(1)),
        "segments: expected",
    ),
    "segment": (lambda tree: tree["segments"].pop(), "segments: expected"),
    "name of a segment": (renamed_leaf, "segments: expected"),
    "leaf of an object": (
        *(lambda tree: tree["objects"][0]["leaves"].pop(), "objects: expected each of the leaves"),
        " object: expected None",
    ),
    **{
        f"object {number}": (
            lambda tree, number=number: tree["objects"][0].update(object=number),
            f" object: expected {number}",
        )
        for number in (-1, 1 << 16, 10**30)
    },
    "contact": (lambda tree: tree["contacts"].pop(0), " samples: expected .*None"),
    "samples": (one_sample_more, " samples: expected"),
    "merged": (
        lambda tree: tree["contacts"][0].update(merged=not tree["contacts"][0]["merged"]),
        " merged: expected",
    ),
    "leaf in contact": (
        *(lambda tree: tree["contacts"][1].update(second="P"), " contact: expected two leaves"),
    ),
    "evidence": (
        lambda tree: tree["contacts"][0]["evidence"].update(crease=0.5),
        " log_odds: expected .*the sum",
    ),
    "all evidence": (likelier_merges, " merges log_odds: expected"),
    "last merge": (lambda tree: tree["merges"].pop(), " merges: expected what became"),
    "all merges": (lambda tree: tree.update(merges=[]), " objects: expected one of "),
    "merge of no group": (
        lambda tree: tree["merges"].insert(0, {**tree["merges"][0], "second": "P"}),
        " merges: expected the first leaves",
    ),
}


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("damage", OF_A_TREE)
def test_what_contradicts_the_lists_of_a_tree_is_found(export, live, damage):
    folder = export("nurbseg")
    folder.settings(temporal=live)
    assert folder.findings() == []
    make, *expected = OF_A_TREE[damage]
    folder.document(make)
    assert folder.finds(*expected), folder.findings()


def times(name, factor):
    def make(arrays):
        arrays[name] = arrays[name] * factor

    return make


def smaller_window(side):
    def make(arrays):
        arrays["window"][0, side] += 1 if side < 2 else -1

    return make


def one_pixel_less(arrays):
    name = arrays["names"][-1]
    arrays[f"{name}_measured"] = arrays[f"{name}_measured"][:-1]


def another_pixel(arrays):
    name = arrays["names"][-1]
    arrays[f"{name}_measured"][0] += 1


def a_pixel_without_a_point(arrays):
    name = arrays["names"][-1]
    arrays[f"{name}_measured"][0] -= 10**6


def turned_weights(arrays):
    arrays[f"{arrays['names'][0]}_weights"][0, 0] = -1.0


def fewer_knots(arrays):
    name = f"{arrays['names'][0]}_knots_u"
    arrays[name] = arrays[name][:-1]


def one_name_less(arrays):
    for key in ("names", "degree", "window"):
        arrays[key] = arrays[key][1:]


#: What is changed of the surfaces, and the field that the finding names.
OF_SURFACES = {
    "top": (smaller_window(0), "window"),
    "left": (smaller_window(1), "window"),
    "bottom": (smaller_window(2), "window"),
    "right": (smaller_window(3), "window"),
    "a window beyond the image": (times("window", 3), "window"),
    "a pixel less": (one_pixel_less, "measured"),
    "another pixel": (another_pixel, "measured"),
    "a pixel without a point": (a_pixel_without_a_point, "measured"),
    "a negative weight": (turned_weights, "weights"),
    "a knot less": (fewer_knots, "knots_u"),
    "a surface less": (one_name_less, "names"),
}


@BOTH
@pytest.mark.parametrize("damage", OF_SURFACES)
def test_damaged_surfaces_are_found(export, name, damage):
    folder = export(name)
    make, field = OF_SURFACES[damage]
    folder.arrays(make)
    for recording in (None, RECORDING):
        assert folder.finds(rf"surfaces.npz: (P[01]* )?{field}: expected", recording=recording)


def moved(name, by_m):
    """Move all control points of a segment along the line of sight."""

    def make(arrays):
        arrays[f"{name}_control_points_m"] = arrays[f"{name}_control_points_m"] * (1 + by_m)

    return make


@ALL
@pytest.mark.parametrize("deep", [False, True])
def test_a_surface_that_moved_a_little_is_found(export, name, deep):
    folder = export(name)
    surfaces = [key for key, segment in folder.segments().items() if segment["surface"]]
    segment = surfaces[-1] if deep else surfaces[0]
    folder.arrays(moved(segment, 1e-4))
    assert folder.findings() == []
    found = folder.findings(RECORDING)
    assert {re.match(r"\d+_tree.json: (P[01]*) ", each)[1] for each in found} == {segment}, found
    assert any(f"{segment} mse: expected" in each for each in found)


def test_a_surface_off_the_rays_of_its_pixels_is_found(export):
    folder = export("nurbseg")

    def aside(arrays):
        arrays[f"{arrays['names'][0]}_control_points_m"][..., 0] += 0.01

    folder.arrays(aside)
    assert folder.finds("control_points_m: expected surface points on their rays", recording=RECORDING)


@ALL
def test_every_wrong_value_is_found_with_the_recording(export, name):
    folder = export(name)
    leaf = folder.first(lambda segment: segment["surface"] and not segment["trial"])
    values = folder.segments()[leaf]["values"]
    assert {"mse", "mae", "ve", "nle"} <= set(values)
    for metric, value in values.items():
        for wrong in (None, value + 1 if metric in ("nle", "nlc") else value * 1.001):
            folder.tree(
                lambda segments, metric=metric, wrong=wrong: segments[leaf]["values"].update({metric: wrong})
            )
            assert folder.finds(f"{leaf} {metric}: expected", recording=RECORDING), metric
        folder.tree(
            lambda segments, metric=metric, value=value: segments[leaf]["values"].update({metric: value})
        )
    assert folder.findings(RECORDING) == []


def test_values_of_another_frame_are_compared_with_that_frame(export):
    folder = export("nurbseg")
    folder.settings(temporal=True)
    assert folder.findings() == []
    cut = next(key for key, segment in folder.segments(frame=1).items() if segment["division"] == "cut")
    before = next(segment for segment in folder.segments().values() if segment["division"] == "cut")
    of_it = {key: before[key] for key in ("value", "values", "points", "trial", "ratio")}
    folder.tree(lambda segments: segments[cut].update(of_it, measured=0, judged=0), frame=1)
    # Its surface and pixels are those of frame 1 still.
    assert {finding.split(": ")[1] for finding in folder.findings()} == {f"{cut} measured"}
    folder.tree(lambda segments: segments[cut].update(points=1), frame=1)
    assert folder.finds(f"{cut} value: expected one of frame 0")
    folder.tree(lambda segments: segments[cut]["trial"].update(points=1), frame=1)
    assert folder.finds(f"{cut} trial: expected one of frame 0")
    folder.tree(lambda segments: segments[cut].update(measured=2), frame=1)
    assert folder.finds(f"{cut} value: expected one of frame 2")
    folder.tree(lambda segments: segments[cut].update(measured=0), frame=1)
    for file in folder.folder.glob("000000_*"):
        file.unlink()
    check = FolderCheck(folder.folder)
    assert not any(" of frame 0" in str(finding) for finding in check.findings())
    assert check.unchecked == 2


def test_another_recording_is_found(export):
    found = export("stag15").findings(rendered("width=160&height=120&frames=2&seed=5"))
    assert [each.split(": ")[0] for each in found] == ["000000_labels.png", "000001_labels.png"]
    assert all(re.search(r"png: pixel \[\d+, \d+\]: expected (a label|no label)", each) for each in found)
    found = export("stag15").findings(rendered("width=160&height=120&frames=1"))
    assert found == ["000001_tree.json: frame: expected one of the recording, without its repeats, found 1"]


def test_a_recording_that_cannot_be_read_hides_no_finding_before_it(export, monkeypatch):
    def damaged(source, timeout_s):
        raise RecordingFormatError("r.mcap: chunks: damaged")

    folder, found = export("stag15"), []
    folder.tree(lambda segments: segments["P"].update(size=1))
    monkeypatch.setattr(RecordingReader, "_read", damaged)
    with pytest.raises(RecordingFormatError, match="damaged"):
        found += FolderCheck(folder.folder, RECORDING).findings()
    assert any(str(each).startswith("000000_tree.json: P size") for each in found)


def test_of_a_looped_replay_the_first_pass_is_compared_with_the_recording(tmp_path, capsys):
    recording = rendered("width=160&height=120&frames=2")
    words = ["--loop", "--frames", "3", "--speed", "0", "--view", "none", "--splits-max", "2"]
    words += ["--export", os.fspath(tmp_path), "--export-surfaces", "--replay", recording]
    subprocess.run([Path(sys.executable).with_name("nurbseg-live"), *words], check=True, timeout=120)
    assert main(["check", os.fspath(tmp_path)]) == 0
    capsys.readouterr()
    assert main(["check", os.fspath(tmp_path), "--frames", recording]) == 1
    [finding] = capsys.readouterr().out.splitlines()
    assert finding == "000002_tree.json: frame: expected one of the recording, without its repeats, found 2"


def test_a_frame_of_another_time_is_found(export):
    folder = export("stag15")
    folder.document(lambda tree: tree.update(timestamp_ns=7, name="another"))
    fields = {finding.split(": ")[1] for finding in folder.findings(RECORDING)}
    assert fields == {"timestamp_ns", "name"}


def truncated(path):
    path.write_bytes(path.read_bytes()[:-30])


def without_a_key(path):
    document = json.loads(path.read_text())
    del document["segments"][0]["points"]
    path.write_text(json.dumps(document))


def with_a_text(path):
    path.write_text(path.read_text().replace('"points": ', '"points": "many", "x": ', 1))


def of_another_size(path):
    cv2.imwrite(str(path), np.zeros((3, 4), dtype=np.uint16))


@pytest.mark.parametrize(
    ("file", "damage", "text"),
    [
        ("tree.json", truncated, "000000_tree.json: expected a file of an export"),
        ("tree.json", without_a_key, "found P points is missing"),
        ("tree.json", with_a_text, "found P points: expected int, got 'many'"),
        ("labels.png", Path.unlink, "000000_labels.png: expected a file of an export, found cannot be read"),
        ("labels.png", truncated, "labels.png: expected a file of an export, found the image is cut off"),
        ("labels.png", of_another_size, "found expected an image (120, 160) uint16, got (3, 4) uint16"),
        (
            "surfaces.npz",
            Path.unlink,
            "000000_surfaces.npz: expected a file of an export, found cannot be read",
        ),
        ("surfaces.npz", truncated, "000000_surfaces.npz: expected a file of an export"),
    ],
)
def test_a_damaged_file_is_a_finding_and_the_next_frame_is_checked(export, file, damage, text):
    folder = export("stag15")
    damage(folder.folder / f"000000_{file}")
    folder.tree(lambda segments: segments["P"].update(size=1), frame=1)
    first, *others = folder.findings()
    assert text in first
    assert any(other.startswith("000001_tree.json: P size") for other in others)


def test_the_command_prints_findings_and_ends_with_1(export, capsys):
    folder = export("stag15")
    assert main(["check", os.fspath(folder.folder), "--frames", RECORDING]) == 0
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "0 findings in 2 frames" in printed.err
    folder.tree(lambda segments: segments["P"].update(ratio=0.5))
    assert main(["check", os.fspath(folder.folder)]) == 1
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines
    assert all(line.startswith("000000_tree.json: P ratio: expected ") for line in lines)
    assert f"{len(lines)} findings in 2 frames" in printed.err


def test_wrong_usage_ends_with_2(export, tmp_path, capsys):
    assert main(["check", os.fspath(tmp_path)]) == 2
    assert "settings.json: does not exist; nurbseg-live --export writes it" in capsys.readouterr().err
    folder = export("stag15").folder
    for file in folder.glob("*_tree.json"):
        file.unlink()
    assert main(["check", os.fspath(folder)]) == 2
    assert "contains no NNNNNN_tree.json" in capsys.readouterr().err
    (folder / "settings.json").write_text('{"source": "", "temporal": false}')
    assert main(["check", os.fspath(folder)]) == 2
    assert "segmentation is missing; export again" in capsys.readouterr().err


def test_values_cannot_be_recomputed_without_surfaces(small_result, tmp_path, capsys):
    Exporter(tmp_path, RunSettings(SegmentationConfig(method="stag15"))).write(small_result)
    assert main(["check", os.fspath(tmp_path)]) == 0
    assert main(["check", os.fspath(tmp_path), "--frames", RECORDING]) == 2
    assert "--export-surfaces writes them" in capsys.readouterr().err


def program(marker):
    """Return a program of the guide."""
    text = rf"<!-- run by the tests: {marker} -->\n```python\n(.*?)```"
    (found,) = re.findall(text, GUIDE.read_text(), re.DOTALL)
    return found


@BOTH
def test_ratios_and_values_follow_as_the_guide_says(export, monkeypatch, name):
    monkeypatch.chdir(export(name).folder)
    known = {"json": json, "Path": Path, "np": np, "BSpline": BSpline}
    exec(program("ratios"), known)
    cuts = [key for key, segment in known["tree"].items() if segment["division"] == "cut"]
    assert len(cuts) > 2
    for cut in cuts:
        assert known["ratio"](cut) == pytest.approx(known["tree"][cut]["ratio"], rel=1e-12)
    with open_source(RECORDING) as source:
        known["points_m"] = register(source.read()).points_m.astype(np.float64)
    with_surface = [key for key, segment in known["tree"].items() if segment["surface"]]
    for key in with_surface:
        exec(program("values").replace("P1", key), known)
        assert known["mse"] == pytest.approx(known["tree"][key]["value"], rel=1e-3)
