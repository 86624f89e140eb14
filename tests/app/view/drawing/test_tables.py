"""What the viewer's table tells of objects."""

import math
import re

import pytest
from rendered import rendered

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.frame import object_table
from nurbseg.drivers.registry import open_source
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import SegmentationConfig


@pytest.fixture(scope="module")
def result() -> FrameResult:
    with open_source(rendered("width=160&height=120&frames=1")) as source:
        return process_frame(source.read(), SegmentationConfig())


def test_the_table_gives_the_error_of_each_object(result: FrameResult) -> None:
    frame = drawn(result, ViewConfig(), "mse")
    errors_mm = {}
    for each in result.objects:
        fits = [result.tree[name].fit for name in each.leaves]
        squares = [value**2 for fit in fits if fit.surface is not None for value in fit.residuals_m.tolist()]
        name = str(each.label) + ("" if each.is_sure else "?")
        # Without the farthest 5 %.
        nearest = sorted(squares)[: math.ceil(0.95 * len(squares))]
        errors_mm[name] = f"{1e3 * math.sqrt(math.fsum(nearest) / len(nearest)):.1f}" if nearest else ""
    rows = [line.split("|") for line in object_table(frame).splitlines()[4:] if line.startswith("|")]
    assert {cells[1].strip(): cells[5].strip() for cells in rows} == errors_mm
    assert len(set(errors_mm.values())) > 3


def test_the_table_says_in_words_why_each_object_was_merged(result: FrameResult) -> None:
    frame = drawn(result, ViewConfig(), "mse")
    text = object_table(frame)
    told = [line for line in text.splitlines() if line.startswith("- **")]
    surface_of = {leaf.name: n for n, leaf in enumerate(result.tree.leaves(), start=1)}
    expected = []
    for label, each in enumerate(result.tree.objects, start=1):
        pairs = []
        for contact in result.tree.contacts:
            if contact.first in each.leaves and contact.second in each.leaves:
                own = {term: value for term, value in contact.evidence.items() if term != "base"}
                values = sorted(own.values(), key=abs, reverse=True)[:2]
                numbers = ", ".join(f"({value:+.1f})" for value in values)
                pairs.append(f"{surface_of[contact.first]} with {surface_of[contact.second]}: {numbers}")
        if pairs:
            expected.append(f"- **{label}**: {'; '.join(pairs)}")
    without_words = re.sub(r"(: |, )[a-z ]+ (?=\([+-])", r"\1", "\n".join(told))
    assert without_words.splitlines() == expected
    assert "they touch (+" in text
    assert len(told) > 1
