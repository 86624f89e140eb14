"""What the viewer's table tells of objects."""

from nurbseg.app.live.tracking import process_frame
from nurbseg.app.view.config import ViewConfig
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.tables import object_table
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig


def test_the_table_gives_the_evidence_by_which_each_object_was_merged() -> None:
    with open_source("synthetic:?width=160&height=120&frames=1") as source:
        result = process_frame(source.read(), SegmentationConfig())
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
