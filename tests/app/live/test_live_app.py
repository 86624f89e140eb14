"""A program's own frames are shown, recorded and published as those of a run."""

from __future__ import annotations

import json
import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from saved_view import read_saved_view
from standing import BOXES, looking, seen

from nurbseg import FramesSource, LiveApp, open_source

CAMERA = looking((0.0, -0.9, 0.7), (0.0, 0.1, 0.0))


def test_frames_are_shown_recorded_and_published(tmp_path: Path) -> None:
    frames = [replace(seen(CAMERA, BOXES, index=n), index=0, timestamp_ns=0) for n in range(3)]
    record, save, lines = (str(tmp_path / name) for name in ("a.mcap", "a.rrd", "lines"))
    with LiveApp(view="none", save=save, record=record, publish=f"jsonl:{lines}", target_hz=0) as app:
        listener = socket.socket(socket.AF_UNIX)
        listener.settimeout(10)
        listener.connect(lines)
        results = [app.process(frame) for frame in frames]
        with listener, listener.makefile() as file:
            told = json.loads(file.readline())
    assert [result.frame.index for result in results] == [0, 1, 2]
    assert len(told["objects"]) == 4 and 0 < told["age_s"] < 60
    with open_source(record) as source:
        again = list(source)
    assert [frame.index for frame in again] == [0, 1, 2]
    for frame, before in zip(again, frames, strict=True):
        np.testing.assert_array_equal(frame.depth_mm, before.depth_mm)
    stamps = [frame.timestamp_ns for frame in again]
    assert stamps == sorted(stamps) and stamps[0] > 0
    assert read_saved_view(Path(save)).frames("world/points") == [0, 1, 2]


def test_the_results_of_a_source_are_yielded_until_it_ends_and_its_file_is_written(tmp_path: Path) -> None:
    frames = [seen(CAMERA, BOXES, index=n) for n in range(3)]
    file = tmp_path / "a.mcap"
    with (
        FramesSource(frames[0].calibration) as source,
        LiveApp(view="none", save_objects=str(file), target_hz=0) as app,
    ):
        results = []
        source.put(frames[0])
        for result in app.results(source):
            results.append(result)
            if len(results) < 3:
                source.put(frames[len(results)])
            else:
                source.end()
    assert [len(result.objects) for result in results] == [4, 4, 4]
    with file.open("rb") as content:
        reader = make_reader(content, decoder_factories=[DecoderFactory()])
        messages = [message for *_, message in reader.iter_decoded_messages(topics=["/nurbseg/objects"])]
    assert [len(message.detections) for message in messages] == [4, 4, 4]


def test_what_is_there_is_kept_and_what_is_unknown_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("a letter")
    with pytest.raises(FileExistsError):
        LiveApp(view="none", record=str(tmp_path / "a.mcap"))
    with pytest.raises(ValueError, match="expected jsonl or foxglove"):
        LiveApp(view="none", publish="ros")
    assert (tmp_path / "a.mcap").read_text() == "a letter"
