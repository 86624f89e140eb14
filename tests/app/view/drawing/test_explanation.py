"""The recording of an explanation, read back: one step at each time of its timeline."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from nurbseg import SegmentationConfig, open_source, segment
from nurbseg.app.live.opening import demo_uri
from nurbseg.app.view.drawing.explanation import save_explanation
from nurbseg.library.explanation.explanation import Explanation
from nurbseg.library.palette import residual_colors


@cache
def demo(method: str = "nurbseg") -> Explanation:
    with open_source(demo_uri()) as source:
        return segment(next(iter(source)), SegmentationConfig(method=method)).explain()  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[int, dict[str, Any]]]:
    """Return what was logged: by path, by step, by component."""
    path = tmp_path_factory.mktemp("explained") / "explanation.rrd"
    save_explanation(demo(), path)
    found: dict[str, dict[int, dict[str, Any]]] = {}
    for chunk in RrdReader(str(path)).stream():
        if "split" in chunk.timeline_names:
            rows = chunk.to_record_batch()
            for name in (name for name in rows.schema.names if ":" in name):
                for number, value in zip(
                    rows.column("split").to_pylist(), rows.column(name).to_pylist(), strict=True
                ):
                    if value is not None:
                        found.setdefault(str(chunk.entity_path), {}).setdefault(number, {})[name] = value
    return found


def test_every_step_has_its_pictures_its_tree_and_its_reason(
    logged: dict[str, dict[int, dict[str, Any]]],
) -> None:
    numbers = {step.number for step in demo().steps}
    paths = ("sides", "whole", "parts", "why", "tree/nodes", "tree/edges", "world/whole", "world/parts")
    assert {path for path in logged if path.startswith("/split")} == {f"/split/{path}" for path in paths}
    for path in paths:
        assert set(logged[f"/split/{path}"]) == numbers


def test_texts_tell_the_sentence_and_the_numbers(logged: dict[str, dict[int, dict[str, Any]]]) -> None:
    for step in demo().steps:
        (text,) = logged["/split/why"][step.number]["TextDocument:text"]
        assert step.sentence[1:] in text
        assert step.verdict in text
        assert all(part.told(step.metric) in text for part in step.parts)


def test_pictures_are_those_of_the_steps(logged: dict[str, dict[int, dict[str, Any]]]) -> None:
    step = demo().steps[1]
    drawn = demo().panels(step)
    for name, image in (("sides", drawn.sides), ("whole", drawn.whole), ("parts", drawn.parts)):
        (blob,) = logged[f"/split/{name}"][step.number]["EncodedImage:blob"]
        shown = cv2.imdecode(np.frombuffer(bytes(blob), dtype=np.uint8), cv2.IMREAD_COLOR_RGB)
        assert np.abs(shown.astype(int) - image).mean() < 6.0


def test_surfaces_have_the_colors_of_their_residuals(logged: dict[str, dict[int, dict[str, Any]]]) -> None:
    step = next(step for step in demo().steps if step.kind == "cut")
    red = int(residual_colors(np.array([1.0]), 1.0)[0])
    shares = []
    for name in ("whole", "parts"):
        mesh = logged[f"/split/world/{name}"][step.number]
        colors = mesh["Mesh3D:vertex_colors"]
        assert len(colors) == len(mesh["Mesh3D:vertex_positions"])
        shares.append(np.mean(np.array(colors) == red))
    # Surfaces of the parts leave less.
    assert shares[0] > 2 * shares[1]


def test_nodes_that_are_not_there_yet_are_faint_and_have_no_name(
    logged: dict[str, dict[int, dict[str, Any]]],
) -> None:
    first, last = 1, len(demo().steps)
    for number, share in ((first, 0.5), (last, 0.0)):
        nodes = logged["/split/tree/nodes"][number]
        faint = np.array(nodes["Points2D:colors"]) & 255 < 255
        assert bool(faint.mean() > share) is (number == first)
        assert not any(
            label for label, is_faint in zip(nodes["Points2D:labels"], faint, strict=True) if is_faint
        )
    # A fold has the ratio that would divide it again: its leaf has none.
    ratios = [step for step in demo().steps if step.kind == "cut" and step.ratio is not None]
    labels = logged["/split/tree/nodes"][ratios[-1].number]["Points2D:labels"]
    assert f"P{ratios[-1].name} {ratios[-1].ratio:.2f}" in labels


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="missing"):
        save_explanation(demo("stag15"), tmp_path / "missing" / "explanation.rrd")
