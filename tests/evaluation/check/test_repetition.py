"""What is changed in an export together with all that follows from it is found by segmenting again."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

import pytest
from rendered import rendered

from nurbseg.app.export.exporter import Exporter
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.common.computer import made_by
from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.check.check import FolderCheck
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation.config import SegmentationConfig

RECORDING = rendered("width=160&height=120&frames=4")
RUNS = {
    "alone": RunSettings(SegmentationConfig(splits_max=8), surfaces=True),
    "live": RunSettings(SegmentationConfig(splits_max=8), surfaces=True, temporal=True),
    "stag15": RunSettings(SegmentationConfig(method="stag15", splits_max=30), surfaces=True),
    "stag15 live": RunSettings(
        SegmentationConfig(method="stag15", splits_max=30), surfaces=True, temporal=True
    ),
}
RUN = pytest.mark.parametrize("run", list(RUNS))


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A folder of each run."""
    parent = tmp_path_factory.mktemp("runs")
    for name, settings in RUNS.items():
        export(parent / name, replace(settings, source=RECORDING, computer=made_by()))
    return parent


def export(folder, settings, first=0):
    segmenter = Segmenter(
        settings.config, temporal=settings.temporal, trials_max=settings.trials_max, every_surface=True
    )
    exporter = Exporter(folder, settings, ExportConfig(objects=True, surfaces=True))
    with open_source(RECORDING) as source:
        for frame in source:
            result = segmenter.process(frame)
            if frame.index >= first:
                exporter.write(result)


@pytest.fixture
def copy(made, tmp_path):
    """A function that returns a copy of a run; with a frame, of what is needed to check that one."""

    def copy(run, frame=None):
        folder = Path(shutil.copytree(made / run, mkdtemp(dir=tmp_path), dirs_exist_ok=True))
        for path in folder.glob("0*") if frame is not None else ():
            number = int(path.name[:6])
            if number > frame or (number < frame and not RUNS[run].temporal):
                path.unlink()
        return folder

    return copy


def checked(folder, recording=RECORDING):
    check = FolderCheck(folder, recording)
    found = [str(finding) for finding in check.findings()]
    return found, check.repeated


def change(path, how):
    document = json.loads(path.read_text())
    how(document)
    path.write_text(json.dumps(document))


@RUN
def test_the_same_comes_out_when_frames_are_segmented_again(copy, run):
    assert checked(copy(run)) == ([], 4)
    assert checked(copy(run, 1)) == ([], 2 if RUNS[run].temporal else 1)


@RUN
def test_the_weight_of_geometry_is_noticed(copy, run):
    folder = copy(run)
    change(folder / "settings.json", lambda each: each["segmentation"].update(geometry_weight=2.0))
    assert "when segmented again" in checked(folder)[0][0]


def test_the_solver_of_the_least_squares_is_noticed(copy):
    folder = copy("stag15")
    change(folder / "settings.json", lambda each: each["segmentation"]["stag15"].update(least_squares="svd"))
    assert "when segmented again" in checked(folder)[0][0]


@RUN
def test_values_of_the_parts_of_a_rejected_trial_are_compared(copy, run):
    folder = copy(run, 0)
    names = []

    def worse(tree):
        each = next(
            segment for segment in tree["segments"] if segment["trial"] and not segment["trial"]["kept"]
        )
        trial = each["trial"]
        trial["parts"][0]["value"] *= 1.01
        each["ratio"] = sum(part["value"] * part["points"] for part in trial["parts"]) / (
            trial["value"] * trial["points"]
        )
        names.append(each["name"])

    change(folder / "000000_tree.json", worse)
    found = [each for each in checked(folder)[0] if each.startswith("000000")]
    assert len(found) == 2
    assert found[0].startswith(f"000000_tree.json: {names[0]} ratio: expected")
    assert found[1].startswith(f"000000_tree.json: {names[0]} trial parts 0 value: expected")


@pytest.mark.parametrize(
    ("factor", "says"), [(0.5, "no less than what is visible"), (4.0, "sides longer by")]
)
def test_a_box_that_does_not_hold_what_is_seen_of_something_round_is_found(copy, factor, says):
    folder = copy("alone", 1)

    def wrong(document):
        rounded = [each for each in document["objects"] if each["box"]["axes"] != each["visible"]["axes"]]
        sides = rounded[0]["box"]["size_m"]
        sides[:2] = [factor * side for side in sides[:2]]

    change(folder / "000001_objects.json", wrong)
    assert any(says in each for each in checked(folder, None)[0])


@pytest.mark.parametrize("run", ["alone", "live"])
@pytest.mark.parametrize(
    "term", ["crease", "gap", "border", "size", "flatness", "shape", "height", "orientation"]
)
def test_evidence_that_was_changed_with_its_sum_is_found(copy, run, term):
    folder = copy(run, 2)

    def likelier(tree):
        each = next(contact for contact in tree["contacts"] if term in contact["evidence"])
        each["evidence"][term] = round(each["evidence"][term] + 0.002, 3)
        each["log_odds"] = round(sum(each["evidence"].values()), 3)

    change(folder / "000002_tree.json", likelier)
    found, _ = checked(folder)
    assert any(f"evidence {term}: expected" in each for each in found)


def test_evidence_of_merged_surfaces_that_was_changed_with_its_sum_is_found(copy):
    folder = copy("alone", 2)

    def likelier(tree):
        each = next(merge for merge in tree["merges"] if merge["evidence"])
        each["evidence"]["crease"] = round(each["evidence"].get("crease", 0.0) + 0.004, 3)
        each["log_odds"] = round(each["log_odds"] + 0.003, 3)

    change(folder / "000002_tree.json", likelier)
    assert any("evidence crease: expected" in each for each in checked(folder)[0])


def test_nothing_is_repeated_that_another_computer_may_round_differently(copy):
    folder = copy("alone")
    change(folder / "settings.json", lambda each: each.update(computer="another"))
    assert checked(folder) == ([], 0)


def test_a_live_tree_is_repeated_with_as_many_trials_in_a_frame(tmp_path):
    settings = replace(RUNS["live"], config=SegmentationConfig(), source=RECORDING, computer=made_by())
    export(tmp_path / "one", replace(settings, trials_max=1))
    found, repeated = checked(tmp_path / "one")
    assert found == []
    assert repeated > 1
    change(tmp_path / "one" / "settings.json", lambda each: each.update(trials_max=0))
    assert checked(tmp_path / "one")[0] != []


def test_nothing_is_repeated_that_a_clock_decided(copy):
    folder = copy("live")
    change(folder / "settings.json", lambda each: each.update(target_fps=5.0))
    assert checked(folder) == ([], 0)


def test_frames_that_continue_others_are_repeated_until_one_is_missing(copy):
    folder = copy("live")
    for path in folder.glob("000002_*"):
        path.unlink()
    found, repeated = checked(folder)
    assert (found, repeated) == ([], 2)


def test_a_live_tree_that_began_before_the_export_is_not_repeated(made, tmp_path):
    settings = replace(RUNS["live"], source=RECORDING, computer=made_by())
    export(tmp_path / "late", settings, first=2)
    assert checked(tmp_path / "late") == ([], 0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("object", 77),
        ("pixels", 5),
        ("centroid_m", [0.0, 0.0, 1.0]),
        ("normal", [0.0, 0.0, -1.0]),
        ("normal", None),
        ("color", [0.0, 0.0, 0.0]),
        ("color", [0.0, 0.0, 300.0]),
        ("rms_m", 0.5),
        ("rms_m", None),
        ("leaves", ["P"]),
    ],
)
@pytest.mark.parametrize("run", ["alone", "live", "stag15"])
def test_a_wrong_measurement_of_an_object_is_found(copy, run, field, value):
    folder = copy(run, 1)
    change(folder / "000001_objects.json", lambda each: each["objects"][1].update({field: value}))
    found, _ = checked(folder)
    assert any(each.startswith("000001_objects.json") and field in each for each in found)


@pytest.mark.parametrize("field", ["pixels", "normal", "rms_m", "leaves", "pending"])
def test_what_the_export_determines_of_an_object_needs_no_recording(copy, field):
    folder = copy("alone", 1)
    wrong = {"pixels": 5, "normal": [0.0, 0.0, -1.0], "rms_m": 0.5, "leaves": [], "pending": True}[field]
    change(folder / "000001_objects.json", lambda each: each["objects"][1].update({field: wrong}))
    found, _ = checked(folder, None)
    assert f"000001_objects.json: object 2 {field}" in [each.partition(": expected")[0] for each in found]


@pytest.mark.parametrize(
    ("field", "place"), [("center_m", 0), ("size_m", 0), ("size_m", 2), ("axes", 1), ("axes", 2)]
)
def test_a_wrong_box_is_found(copy, field, place):
    folder = copy("alone", 1)

    def moved(document):
        values = document["objects"][1]["box"][field]
        values[place] = [1.0, 0.0, 0.0] if field == "axes" else values[place] + 0.001

    change(folder / "000001_objects.json", moved)
    assert any(field in each for each in checked(folder)[0])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("frame", 3),
        ("name", "kitchen"),
        ("timestamp_ns", 5),
        ("coordinates", "the camera's"),
        ("level", "surfaces"),
        ("camera", {"fx": 500.0}),
        ("camera", {"width": 5}),
        ("objects", []),
    ],
)
def test_what_the_file_of_objects_says_of_its_frame_is_compared(copy, field, value):
    folder = copy("alone", 1)

    def other(document):
        document[field] = document[field] | value if isinstance(value, dict) else value

    change(folder / "000001_objects.json", other)
    assert any(each.startswith(f"000001_objects.json: {field}") for each in checked(folder)[0])


def test_a_damaged_file_of_objects_is_named(copy):
    folder = copy("alone")
    change(folder / "000001_objects.json", lambda each: each["objects"][0].pop("color"))
    assert checked(folder)[0] == ["000001_objects.json: expected a file of an export, found color is missing"]


def aside(each):
    middle, first = each["box"]["center_m"], each["box"]["axes"][0]
    each["box"]["center_m"] = [round(x + 0.3 * y, 6) for x, y in zip(middle, first, strict=True)]


def turned(each):
    (a, b, up), half = each["visible"]["axes"], 0.5**0.5
    each["visible"]["axes"] = [
        [round(half * (x + y), 6) for x, y in zip(a, b, strict=True)],
        [round(half * (y - x), 6) for x, y in zip(a, b, strict=True)],
        up,
    ]


def lifted(each):
    each["support_from_object"][2][3] += 0.1


@pytest.mark.parametrize(("how", "field"), [(aside, "box"), (turned, "visible"), (lifted, "support_from")])
def test_a_box_that_is_not_around_its_object_is_found(copy, how, field):
    folder = copy("alone", 1)
    change(folder / "000001_objects.json", lambda document: how(document["objects"][2]))
    assert any(f"object 3 {field}" in each for each in checked(folder)[0])


@pytest.mark.parametrize("run", ["alone", "live"])
@pytest.mark.parametrize(
    "column",
    ["frame", "name", "object", "pixels", "size_m_2", "normal_z", "rms_m", "sigma_yaw_rad", "leaves"],
)
def test_a_wrong_cell_of_the_table_of_objects_is_found(copy, run, column):
    folder = copy(run)
    assert checked(folder, None) == ([], 0)
    lines = (folder / "objects.csv").read_text().splitlines()
    row, place = lines[4].split(","), lines[0].split(",").index(column)
    row[place] = row[place] + "1"
    (folder / "objects.csv").write_text("\n".join([*lines[:4], ",".join(row), *lines[5:]]) + "\n")
    found, _ = checked(folder, None)
    wrong = "object" if column == "frame" else column
    assert found and all(each.startswith("objects.csv: 00") and f" {wrong}: " in each for each in found)


def test_a_damaged_table_of_objects_is_named(copy):
    folder = copy("alone")
    (folder / "objects.csv").write_bytes(b"frame,\xff")
    (found,) = checked(folder, None)[0]
    assert found.startswith("objects.csv:") and "not a table of objects" in found
    (folder / "objects.csv").unlink()
    assert checked(folder, None)[0] == []


@pytest.mark.parametrize(
    ("run", "term", "more"),
    [
        ("alone", "base", 0.002),
        ("alone", "kept", 1.5),
        ("live", "kept", 3.1),
        ("live", "flat", 0.1),
    ],
)
def test_evidence_that_cannot_be_is_found_without_the_recording(copy, run, term, more):
    folder = copy(run, 2)

    def likelier(tree):
        each = next(contact for contact in tree["contacts"] if "base" in contact["evidence"])
        each["evidence"][term] = round(each["evidence"].get(term, 0.0) + more, 3)
        each["log_odds"] = round(sum(each["evidence"].values()), 3)

    change(folder / "000002_tree.json", likelier)
    assert any(f"evidence {term}: expected" in each for each in checked(folder, None)[0])
