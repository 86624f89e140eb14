from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace

import cv2
import numpy as np
import psutil
import pytest
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.chunk import RrdReader

import nurbseg
from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import Layout, ViewConfig
from nurbseg.app.view.drawing.blueprint import blueprint
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.entities import COLOR, FrameEntities
from nurbseg.app.view.opening import open_view
from nurbseg.app.view.program import RerunView, _handle_messages
from nurbseg.app.view.stream import FileSink, Item, Writer
from nurbseg.app.view.view import Close, Open, View
from nurbseg.app.view.viewer import viewer_executable
from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.library.palette import DIVISION_COLORS, STOP_COLORS
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.vocabulary import StopReason
from tests.fakes.fair_clock import FairClock
from tests.fakes.saved_view import SavedView, read_saved_view
from tests.fakes.small_scene import CONFIG, HEIGHT, WIDTH, numbered, small_frame, small_result

FRAMES = 12


@pytest.fixture(scope="module")
def results() -> list[FrameResult]:
    return [small_result(index) for index in range(FRAMES)]


@pytest.fixture(scope="module")
def saved(results: list[FrameResult], tmp_path_factory: pytest.TempPathFactory) -> SavedView:
    path = tmp_path_factory.mktemp("view") / "all.rrd"
    config = ViewConfig(mode="none", save=str(path), points_max=2000)
    logger = logging.getLogger("nurbseg.test_view")
    logger.setLevel(logging.INFO)
    with open_view(config, CONFIG, {"name": "a camera", "serial": "B0042", "seed": "0"}) as view:
        for result in results:
            view.show(result)
            logger.info("frame %d is shown", result.frame.index)
        logger.warning("that was all")
    logger.info("nobody sees this")
    return read_saved_view(path)


@pytest.mark.parametrize(
    "path",
    [
        "world/camera/image/color",
        "world/camera/image/depth",
        "world/camera/image/objects",
        "world/camera/image/surfaces",
        "world/camera/outlines",
        "world/camera/ground_truth",
        "world/points",
        "world/surfaces",
        "world/surfaces/isolines",
        "tree",
        "objects",
        "splits",
        "plots/segments",
        "plots/metric/worst",
        "plots/metric/mean",
        "plots/latency/register",
        "plots/latency/segment",
    ],
)
def test_every_entity_is_in_the_file_for_every_frame(saved: SavedView, path: str) -> None:
    assert saved.frames(path) == list(range(FRAMES))


def test_a_program_logs_the_same_to_a_recording_of_its_own(
    saved: SavedView, results: list[FrameResult], tmp_path: Path
) -> None:
    stream = rr.RecordingStream("a_program")
    stream.save(tmp_path / "own.rrd")
    for result in results:
        nurbseg.show(result, stream)
    stream.flush(timeout_sec=30.0)
    stream.disconnect()
    own = read_saved_view(tmp_path / "own.rrd")
    # But for the log, and for what depends on when frames came.
    assert {path for path in saved.by_frame if path not in ("log", "plots/rate")} == set(own.by_frame)
    assert {path for path in saved.static if not path.startswith("__")} <= {*own.static, "log", "plots/rate"}
    for path in ("world/camera/image/depth", "world/camera/image/surfaces", "splits"):
        for name, values in saved.by_frame[path].items():
            assert dict(own.by_frame[path][name]) == dict(values)
    # In a process where nothing has called rerun.init.
    program = "import nurbseg; nurbseg.show(None)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert "ValueError: recording: there is none; call rerun.init" in done.stderr


def test_the_rate_is_known_from_the_second_frame_on(saved: SavedView) -> None:
    rates = saved.by_frame["plots/rate"]["Scalars:scalars"]
    assert sorted(rates) == list(range(1, FRAMES))
    assert all(rate[0] > 0 for rate in rates.values())


def test_images_come_back_as_they_were(saved: SavedView, results: list[FrameResult]) -> None:
    for index in (0, FRAMES - 1):
        result = results[index]
        depth = saved.by_frame["world/camera/image/depth"]
        image = np.frombuffer(bytes(depth["DepthImage:buffer"][index][0]), np.uint16)
        assert (image.reshape(HEIGHT, WIDTH) == result.frame.depth_mm).all()
        assert depth["DepthImage:meter"][index] == [1000.0]

        blob = bytes(saved.by_frame["world/camera/image/color"]["EncodedImage:blob"][index][0])
        color = cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert color.shape == result.frame.color.shape
        assert np.abs(color.astype(int) - result.frame.color).mean() < 4.0

        assert (label_image(saved, "objects", index) == result.labels("objects")).all()
        # Shades of the objects' colors, one for each surface.
        pairs = np.stack([label_image(saved, "surfaces", index), result.labels("surfaces")], axis=-1)
        surfaces = np.unique(pairs.reshape(-1, 2), axis=0)
        assert len(surfaces) == len(np.unique(surfaces[:, 0])) == len(np.unique(surfaces[:, 1])) > 2


def label_image(saved: SavedView, name: str, index: int) -> NDArray[np.uint16]:
    values = saved.by_frame[f"world/camera/image/{name}"]["SegmentationImage:buffer"][index][0]
    return np.frombuffer(bytes(values), np.uint16).reshape(HEIGHT, WIDTH)


def test_segments_without_objects_come_back_with_their_labels(tmp_path: Path) -> None:
    result = process_frame(small_frame(), replace(CONFIG, method="stag15"))
    path = tmp_path / "a.rrd"
    with open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        view.show(result)
    saved = read_saved_view(path)
    assert (label_image(saved, "labels", 0) == result.labels()).all()
    assert saved.frames("world/camera/image/surfaces") == []


def test_what_is_pending_is_not_shown_as_a_sure_object(tmp_path: Path, results: list[FrameResult]) -> None:
    tree = results[0].tree
    late, *others = tree.leaves()
    segments = tuple(
        replace(segment, stop=StopReason.PENDING) if segment is late else segment for segment in tree.segments
    )
    path = tmp_path / "a.rrd"
    with open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        view.show(replace(results[0], tree=replace(tree, segments=segments)))
    image = label_image(read_saved_view(path), "objects", 0).ravel()
    assert np.unique(image[late.pixels]).tolist() == [65534]
    assert 65534 not in image[np.concatenate([other.pixels for other in others])]


def test_points_are_colored_by_label(saved: SavedView, results: list[FrameResult]) -> None:
    points = saved.by_frame["world/points"]
    positions = np.array(points["Points3D:positions"][3])
    classes = np.array(points["Points3D:class_ids"][3])
    assert 1000 < len(positions) <= 2000
    camera = results[3].frame.calibration.depth
    u = np.rint(camera.fx * positions[:, 0] / positions[:, 2] + camera.cx).astype(int)
    v = np.rint(camera.fy * positions[:, 1] / positions[:, 2] + camera.cy).astype(int)
    assert (results[3].tree.labels("surfaces")[v, u] == classes).all()
    assert (classes > 0).all()


def test_surfaces_are_one_mesh_with_a_color_for_each_vertex(saved: SavedView) -> None:
    mesh = {name: values[0] for name, values in saved.by_frame["world/surfaces"].items()}
    vertices = len(mesh["Mesh3D:vertex_positions"])
    assert vertices > 100
    assert len(mesh["Mesh3D:vertex_colors"]) == len(mesh["Mesh3D:vertex_normals"]) == vertices
    assert np.max(mesh["Mesh3D:triangle_indices"]) == vertices - 1


def views_of(part: rrb.Container | rrb.View) -> Iterator[rrb.View]:
    if isinstance(part, rrb.View):
        yield part
    else:
        for content in part.contents:
            yield from views_of(content)


@pytest.mark.parametrize("layout", ["full", "compact"])
def test_each_view_holds_data_and_all_that_is_drawn_is_seen(
    saved: SavedView, results: list[FrameResult], layout: Layout
) -> None:
    frame = drawn(results[0], ViewConfig(), "mse")
    assert frame.truth is not None and frame.objects is not None
    logged = {*saved.by_frame, *saved.static}
    seen: set[str] = set()
    for view in views_of(blueprint(frame, ViewConfig(layout=layout)).root_container):
        for query in [view.contents] if isinstance(view.contents, str) else view.contents:
            path = query.replace("$origin", view.origin).removesuffix("/**")
            found = {each for each in logged if each == path or each.startswith(f"{path}/")}
            assert found, f"{view.name}: {query}"
            seen |= found
    # What is left are the annotations of all below.
    assert {each for each in logged - seen if not each.startswith("__")} == {"world"}


def test_the_layout_follows_what_frames_hold(
    results: list[FrameResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = rr.RecordingStream("nurbseg")
    stream.memory_recording()
    sent: list[object] = []
    monkeypatch.setattr(type(stream), "send_blueprint", lambda _, layout: sent.append(layout))
    writer = Writer()
    frame = drawn(results[0], ViewConfig(), "mse")
    assert frame.objects is not None
    for each in (frame, frame, replace(frame, objects=None), replace(frame, objects=None), frame):
        writer.write(stream, FrameEntities(each, ViewConfig()))
    assert len(sent) == 3


@pytest.mark.parametrize(
    ("config", "kind"),
    [
        (ViewConfig(mode="serve"), rr.Image),
        (ViewConfig(mode="serve", save="a.rrd"), rr.EncodedImage),
        (ViewConfig(mode="spawn"), rr.EncodedImage),
    ],
)
def test_only_a_browser_gets_uncompressed_color(
    results: list[FrameResult], config: ViewConfig, kind: type
) -> None:
    entities = dict(FrameEntities(drawn(results[0], config, "mse"), config).entities)
    assert type(entities[COLOR]) is kind


def test_a_viewer_follows_the_time_of_day_once_frames_went_back(
    results: list[FrameResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = rr.RecordingStream("nurbseg")
    stream.memory_recording()
    sent: list[rrb.Blueprint] = []
    monkeypatch.setattr(type(stream), "send_blueprint", lambda _, layout: sent.append(layout))
    writer = Writer()
    for index in (4, 5, 3, 4, 5, 2):
        frame = drawn(numbered(results[0], index), ViewConfig(), "mse")
        writer.write(stream, FrameEntities(frame, ViewConfig()))
    assert [layout.time_panel.timeline for layout in sent] == ["frame", "log_time"]


def test_the_trees_nodes_are_filled_by_stop_reason(saved: SavedView, results: list[FrameResult]) -> None:
    tree = {name: values[5] for name, values in saved.by_frame["tree"].items()}
    segments = results[5].tree.segments
    names = tree["GraphNodes:node_ids"]
    assert names[: len(segments)] == [f"P{segment.name}" for segment in segments]
    fills = [
        ((each >> 24) & 255, (each >> 16) & 255, (each >> 8) & 255) for each in tree["GraphNodes:colors"]
    ]
    assert fills[: len(segments)] == [
        DIVISION_COLORS[segment.division] if segment.stop is None else STOP_COLORS[segment.stop]
        for segment in segments
    ]
    edges = {(edge["first"], edge["second"]) for edge in tree["GraphEdges:edges"]}
    assert edges == {
        (f"P{segment.parent}", f"P{segment.name}") for segment in segments if segment.parent is not None
    }
    assert len(tree["GraphNodes:positions"]) == len(names) == len(segments) + len(results[5].tree.leaves())


def test_the_table_has_every_segment(saved: SavedView, results: list[FrameResult]) -> None:
    text = saved.by_frame["splits"]["TextDocument:text"][0][0]
    tree = results[0].tree
    assert f"**small0**: {len(tree.leaves())} final segments of {len(tree.segments)}" in text
    label = 0
    for segment in tree.segments:
        label += segment.is_leaf
        cells = next(line for line in text.splitlines() if line.startswith(f"| P{segment.name} |")).split("|")
        assert cells[2].strip() == (str(label) if segment.is_leaf else "")
        assert cells[3].strip() == f"{segment.pixels.size:,}"
        if segment.is_leaf or "mse" in segment.fit.values:
            assert float(cells[4]) == pytest.approx(segment.fit.values["mse"], rel=0.01)
        else:  # a method may fit the final segments only
            assert cells[4].strip() == ""
        assert cells[6].strip() == (segment.stop or segment.division)


def test_what_holds_for_the_recording_is_static(saved: SavedView) -> None:
    assert saved.static["world"]["ViewCoordinates:xyz"] == [[3, 2, 5]]  # right, down, forward
    pinhole = saved.static["world/camera"]
    assert pinhole["Pinhole:resolution"] == [[WIDTH, HEIGHT]]
    assert np.reshape(pinhole["Pinhole:image_from_camera"], (3, 3)).T[0] == pytest.approx([131.0, 0.0, 79.5])
    context = saved.static["world"]["AnnotationContext:context"][0]
    # Nothing, the colors of labels, what was not found, and what is pending.
    assert len(context) == 1 + 1023 + 2
    assert "distances between surface and data" in saved.static["legend"]["TextDocument:text"][0]


def test_device_settings_and_versions_are_kept_with_the_recording(saved: SavedView) -> None:
    assert saved.static["__properties/device"]["serial"] == ["B0042"]
    assert saved.static["__properties/segmentation"]["segment_pixels_min"] == ["400"]
    assert saved.static["__properties/versions"]["numpy"] == [np.__version__]


def test_the_programs_log_is_kept_until_the_view_closes(saved: SavedView) -> None:
    assert sorted(saved.texts) == sorted(
        [*(("INFO", f"frame {index} is shown") for index in range(FRAMES)), ("WARN", "that was all")]
    )


def test_an_unregistered_pair_shows_both_cameras(tmp_path: Path) -> None:
    camera = Intrinsics(WIDTH, HEIGHT, 131.0, 131.0, 79.5, 59.5)
    transform = np.eye(4)
    transform[0, 3] = -0.025
    path = tmp_path / "pair.rrd"
    with open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        view.show(small_result(calibration=Calibration(camera, camera, transform)))
    saved = read_saved_view(path)
    assert saved.frames("world/color_camera/image") == saved.frames("world/camera/image/color") == [0]
    assert saved.static["world/color_camera"]["Transform3D:translation"][0] == pytest.approx([-0.025, 0, 0])


def test_a_frame_without_depth_is_shown_too(tmp_path: Path) -> None:
    frame = small_frame(truth=False)
    frame = replace(frame, depth_mm=np.zeros_like(frame.depth_mm))
    path = tmp_path / "blind.rrd"
    with open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        view.show(process_frame(frame, CONFIG))
    saved = read_saved_view(path)
    assert saved.frames("world/camera/image/color") == saved.frames("world/surfaces") == [0]
    assert saved.frames("world/camera/ground_truth") == []


def test_a_date_as_the_device_clock_stays_one(tmp_path: Path) -> None:
    result = small_result()
    frame = replace(result.frame, timestamp_ns=1_305_031_102_175_304_000)
    path = tmp_path / "date.rrd"
    with open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        view.show(replace(result, frame=frame))
    moments = {
        moment
        for chunk in RrdReader(str(path)).stream()
        if "device_time" in chunk.timeline_names
        for moment in chunk.to_record_batch().column("device_time").to_numpy()
    }
    assert moments == {np.datetime64(1_305_031_102_175_304_000, "ns")}


def test_a_file_that_cannot_be_created_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    path = tmp_path / "file" / "a.rrd"
    with pytest.raises(ViewError, match=r"file/a\.rrd: cannot be created"):
        open_view(ViewConfig(mode="none", save=str(path)), CONFIG)


def _start(script: str, path: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script), str(path)],
        cwd=Path(__file__).parents[3],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def test_a_full_disk_is_reported_at_once_and_nothing_is_left_waiting(results: list[FrameResult]) -> None:
    view = open_view(ViewConfig(mode="none", save="/dev/full"), CONFIG)
    with FairClock() as clock, pytest.raises(ViewError, match="cannot be written: No space left on device"):
        while True:
            view.show(results[0])
            assert clock.lap_s() < 10.0
    with FairClock() as clock, pytest.raises(ViewError, match="No space left on device"):
        view.close()
    assert clock.elapsed_s < 2.0


def test_nothing_to_show_and_nothing_to_save_costs_nothing(results: list[FrameResult]) -> None:
    with open_view(ViewConfig(mode="none"), CONFIG) as view:
        assert type(view) is View
        view.show(results[0])


def test_without_a_display_auto_says_how_to_look(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with open_view(ViewConfig(), CONFIG) as view:
        for way in ("--view serve", "--connect HOST", "--save FILE.rrd"):
            assert way in view.viewer_hint


def test_saving_listens_nowhere(tmp_path: Path) -> None:
    with open_view(ViewConfig(mode="none", save=str(tmp_path / "a.rrd")), CONFIG) as view:
        view.show(small_result())
        connections = psutil.Process().net_connections("inet")
        assert [connection for connection in connections if connection.status == psutil.CONN_LISTEN] == []


def test_showing_twice_after_closing_is_refused(tmp_path: Path, results: list[FrameResult]) -> None:
    view = open_view(ViewConfig(mode="none", save=str(tmp_path / "a.rrd")), CONFIG)
    view.close()
    view.close()
    with pytest.raises(ViewError, match="the view is closed"):
        view.show(results[0])


def test_stages_that_come_later_are_plotted_too(tmp_path: Path, results: list[FrameResult]) -> None:
    path = tmp_path / "stages.rrd"
    with open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        view.show(results[0])
        view.show(replace(results[1], elapsed_ms=MappingProxyType({"register": 1.0, "merge_leaves": 4.0})))
    saved = read_saved_view(path)
    assert saved.by_frame["plots/latency/merge_leaves"]["Scalars:scalars"] == {1: [4.0]}
    assert saved.static["plots/latency/merge_leaves"]["SeriesLines:names"] == ["merge leaves"]


# As the command does: a handler that notes the signal, so that no destructor can swallow the interruption
# and no foreign thread can keep it from the main one.
_SAVER = """
    import signal, sys, threading, time
    from nurbseg.app.view.opening import open_view
    from nurbseg.app.settings.output_config import ViewConfig
    from tests.fakes.small_scene import CONFIG, small_result

    interrupted = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: interrupted.set())
    result = small_result()
    with open_view(ViewConfig(mode="none", save=sys.argv[1]), CONFIG) as view:
        for _ in range(5):
            view.show(result)
        print("shown", flush=True)
        deadline_s = time.monotonic() + 60.0
        while not interrupted.wait(0.02) and time.monotonic() < deadline_s:
            pass
        raise KeyboardInterrupt
"""


def test_ctrl_c_leaves_a_whole_file_within_two_seconds(tmp_path: Path) -> None:
    path = tmp_path / "interrupted.rrd"
    with _start(_SAVER, path) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "shown\n"
        with FairClock(process.pid) as clock:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=60.0)
        assert clock.elapsed_s < 2.0
    assert read_saved_view(path).frames("world/camera/image/depth") == [0]
    subprocess.run([viewer_executable(), "rrd", "verify", path], check=True, capture_output=True, timeout=60)


def unasked(command: str) -> None:
    raise AssertionError(f"nobody asks for {command}")


def test_showing_waits_for_a_file_that_grows_slowly(
    tmp_path: Path, results: list[FrameResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "slow.rrd"
    message = Open(ViewConfig(mode="none", save=str(path)), CONFIG, {}, "slow", logging.INFO)
    view = RerunView(message, ask=unasked)
    written = Writer.write

    def slowly(writer: Writer, stream: rr.RecordingStream, item: Item) -> None:
        time.sleep(0.4)
        written(writer, stream, item)

    monkeypatch.setattr(Writer, "write", slowly)
    for index in range(6):
        view.show(drawn(numbered(results[0], index), ViewConfig(), CONFIG.metric))
    view.close(file_limit_s=1.5)
    assert read_saved_view(path).frames("world/camera/image/depth") == list(range(6))


def test_no_message_is_lost_where_the_disk_is_stuck(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problems = iter(["stuck", "still stuck"])

    def stuck(sink: FileSink) -> None:
        raise ViewError(next(problems))

    message = Open(ViewConfig(mode="none", save=str(tmp_path / "a.rrd")), CONFIG, {}, "a", logging.INFO)
    view = RerunView(message, ask=unasked)
    monkeypatch.setattr(FileSink, "flush_if_due", stuck)
    messages, sent = iter([None, None, Close(3.0)]), []
    channel = SimpleNamespace(receive=lambda _: next(messages), send=sent.append, beat=lambda: None)
    assert _handle_messages(view, channel) == 3.0  # type: ignore[arg-type]
    assert [state.problem for state in sent] == ["", "stuck"]
    view.close()


#: Read by Python itself as it starts.
_SLOW_WRITER = """
    import time
    from nurbseg.app.view.stream import Writer

    written = Writer.write

    def slowly(writer, stream, item):
        time.sleep(0.4)
        written(writer, stream, item)

    Writer.write = slowly
"""


def test_a_process_that_writes_slowly_is_waited_for(
    tmp_path: Path, results: list[FrameResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text(textwrap.dedent(_SLOW_WRITER))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    path = tmp_path / "slow.rrd"
    with pytest.raises(KeyboardInterrupt), open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        for result in results[:7]:
            view.show(result)
        raise KeyboardInterrupt
    assert len(read_saved_view(path).frames("world/camera/image/depth")) == 7


@pytest.mark.parametrize("both", [False, True], ids=["one process", "both processes"])
def test_a_kill_leaves_what_was_saved_until_then(both: bool, tmp_path: Path) -> None:
    path = tmp_path / "killed.rrd"
    with _start(_SAVER, path) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "shown\n"
        deadline_s = time.monotonic() + 60.0
        while not _holds_a_frame(path):
            assert time.monotonic() < deadline_s
            time.sleep(0.1)
        (saver,) = psutil.Process(process.pid).children()
        for number in (saver.pid, process.pid) if both else (process.pid,):
            os.kill(number, signal.SIGKILL)
        process.wait(timeout=60.0)
        saver.wait(timeout=60.0)
    # Where only the program was killed, the process that saves lives on until the file is whole.
    assert read_saved_view(path, indexed=not both).frames("world/camera/image/depth") == [0]


def _holds_a_frame(path: Path) -> bool:
    try:
        return bool(read_saved_view(path, indexed=False).frames("world/camera/image/depth"))
    except RuntimeError:
        return False  # caught in the middle of a write
