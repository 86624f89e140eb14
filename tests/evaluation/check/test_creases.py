"""The check computes creases anew from planes and splines of its own, and finds what contradicts them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corner import FOCAL, corner, fold
from numpy.typing import NDArray

from nurbseg.app.export.exporter import Exporter
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.registry import open_source
from nurbseg.library.segmenter import Segmenter, process_frame
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap


def frame_of(cloud: PointMap, index: int = 0) -> RGBDFrame:
    depth_mm: NDArray[np.uint16] = np.round(1000.0 * cloud.points_m[..., 2]).astype(np.uint16)
    frame = RGBDFrame.from_arrays(depth_mm, np.asarray(cloud.color), FOCAL, FOCAL, 159.5, 119.5)
    return replace(frame, index=index, timestamp_ns=33_000_000 * index)


def recorded(path: Path, clouds: list[PointMap]) -> list[RGBDFrame]:
    frames = [frame_of(cloud, index) for index, cloud in enumerate(clouds)]
    with RecordingWriter(path, frames[0].calibration, color_format="png") as writer:
        for frame in frames:
            writer.write(frame)
    with open_source(str(path)) as source:
        return list(source)


@pytest.fixture
def alone(tmp_path, export_in):
    """The export of a floor and a wall, and their recording."""
    recording = tmp_path / "corner.mcap"
    (frame,) = recorded(recording, [corner()[0]])
    config = SegmentationConfig()
    settings = RunSettings(config, source=str(recording), surfaces=True)
    Exporter(tmp_path / "out", settings).write(process_frame(frame, config))
    return export_in(tmp_path / "out"), str(recording)


def test_nothing_is_found_in_a_crease(alone):
    export, recording = alone
    root = export.segments()["P"]
    assert (root["division"], root["trial"]["metric"]) == ("crease", "mse")
    assert export.findings(recording) == []


def test_nothing_is_found_in_creases_of_live_frames(tmp_path, export_in):
    recording, config = tmp_path / "fold.mcap", SegmentationConfig()
    frames = recorded(recording, [fold(degrees, n)[0] for n, degrees in enumerate((0, 8, 16, 24, 30, 8))])
    settings = RunSettings(config, source=str(recording), temporal=True, surfaces=True)
    exporter, segmenter = Exporter(tmp_path / "out", settings), Segmenter(config)
    for frame in frames:
        exporter.write(segmenter.process(frame))
    export = export_in(tmp_path / "out")
    assert [export.segments(frame=n)["P"]["division"] for n in range(6)] == [None] * 3 + ["crease"] * 2 + [
        None
    ]
    assert export.segments(frame=4)["P"]["judged"] == 3
    assert export.findings(str(recording)) == []


def scaled(trial: dict[str, Any], factor: float) -> None:
    """Change the values of all parts and of the whole alike, so that the ratio is the same."""
    for part in (trial, *trial["parts"]):
        part["value"] *= factor


def moved(trial: dict[str, Any]) -> None:
    """Change two values so that the ratio is the same."""
    one, other = trial["parts"]
    one["value"] *= 1.01
    other["value"] -= 0.01 / 1.01 * one["value"] * one["points"] / other["points"]


@pytest.mark.parametrize(
    ("damage", "found"),
    [
        (lambda root: scaled(root["trial"], 1.01), "P trial: expected values and points"),
        (lambda root: moved(root["trial"]), "P trial: expected values and points"),
        (lambda root: root.update(trial=None, ratio=None), "P trial: expected the one that was kept"),
        (lambda root: root["trial"].update(metric="mae"), "P trial metric: expected mse"),
        (lambda root: root["trial"].update(kept=False), "P trial: expected kept where the ratio is below 1"),
        (lambda root: root.update(ratio=0.5), "P ratio: expected"),
        (lambda root: root.update(division="protrusion"), "P trial: expected none of a protrusion"),
        (lambda root: root.update(division="gap"), "P division: expected no trial"),
        (lambda root: root.update(division="cut"), "P trial: expected ("),
    ],
)
def test_a_falsified_crease_is_found(alone, damage, found):
    export, recording = alone
    export.tree(lambda segments: damage(segments["P"]))
    assert any(found in finding for finding in export.findings(recording)), export.findings(recording)


def test_a_crease_that_is_switched_off_is_found(alone):
    export, _ = alone
    export.setting("split_creases", False)
    expected = "000000_tree.json: P division: expected no crease with these settings, found crease"
    assert expected in export.findings()


def test_a_crease_between_planes_that_hardly_meet_at_an_angle_is_found(tmp_path, export_in, monkeypatch):
    monkeypatch.setattr("nurbseg.segmentation.extended.creases.ANGLE_LEAST", 10.0)
    recording, config = tmp_path / "fold.mcap", SegmentationConfig()
    (frame,) = recorded(recording, [fold(17)[0]])
    settings = RunSettings(config, source=str(recording), surfaces=True)
    Exporter(tmp_path / "out", settings).write(process_frame(frame, config))
    monkeypatch.undo()
    found = export_in(tmp_path / "out").findings(str(recording))
    assert any("P division: expected planes that meet at 20 degrees, found 1" in each for each in found), (
        found
    )
