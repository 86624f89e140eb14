"""What the viewer's table tells of objects."""

import math

import pytest
from rendered import rendered

from nurbseg.app.settings.view_config import ViewConfig
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.tables import object_table
from nurbseg.drivers.registry import open_source
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import SegmentationConfig


@pytest.fixture(scope="module")
def result() -> FrameResult:
    with open_source(rendered("width=160&height=120&frames=1")) as source:
        return process_frame(source.read(), SegmentationConfig())


def test_the_table_gives_the_error_of_each_object_at_the_vertices_shown(result: FrameResult) -> None:
    frame = drawn(result, ViewConfig(), "mse")
    object_of = dict(zip(result.surface_labels, result.object_of_leaf[1:].tolist(), strict=True))
    squares_m2: dict[int, list[float]] = {each.label: [] for each in result.objects}
    for label, residual_m in zip(frame.mesh.labels.tolist(), frame.mesh.residuals_m.tolist(), strict=True):
        squares_m2[object_of[label]].append(residual_m**2)
    errors_mm = {
        str(thing): f"{1e3 * math.sqrt(math.fsum(squares) / len(squares)):.1f}" if squares else ""
        for thing, squares in squares_m2.items()
    }
    rows = [line.split("|") for line in object_table(frame).splitlines()[4:] if line.startswith("|")]
    assert {cells[1].strip(): cells[6].strip() for cells in rows} == errors_mm
    assert len(set(errors_mm.values())) > 3


def test_the_table_gives_the_evidence_by_which_each_object_was_merged(result: FrameResult) -> None:
    frame = drawn(result, ViewConfig(), "mse")
    told = [line for line in object_table(frame).splitlines() if line.startswith("- **")]
    surface_of = {leaf.name: n for n, leaf in enumerate(result.tree.leaves(), start=1)}
    expected = []
    for label, each in enumerate(result.tree.objects, start=1):
        pairs = [
            f"{surface_of[contact.first]} with {surface_of[contact.second]}: {contact.reason}"
            for contact in result.tree.contacts
            if contact.first in each.leaves and contact.second in each.leaves
        ]
        if pairs:
            expected.append(f"- **{label}**: {'; '.join(pairs)}")
    assert told == expected
    assert len(told) > 1
