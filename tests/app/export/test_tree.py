"""The tree as a graph, read by Graphviz."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace

import pytest

from nurbseg.app.export.tree import tree_document, tree_graph
from nurbseg.library.result import FrameResult


def test_the_graph_has_every_segment_and_its_children(merged: FrameResult) -> None:
    graph = tree_graph(merged, "mse")
    nodes = dict(re.findall(r"^  (P[01]*) \[label=\"(.*)\"\];$", graph, re.MULTILINE))
    assert set(nodes) == {f"P{segment.name}" for segment in merged.tree.segments}
    edges = re.findall(r"^  (P[01]*) -> (P[01]*);$", graph, re.MULTILINE)
    assert sorted(edges) == sorted(
        (f"P{segment.name}", f"P{child}") for segment in merged.tree.segments for child in segment.children
    )
    for each in merged.objects:
        assert all(f"object {each.label}" in nodes[f"P{name}"].split("\\n") for name in each.leaves)
    for leaf in merged.tree.leaves():
        assert leaf.stop is not None
        assert leaf.stop.value in nodes[f"P{leaf.name}"]
        assert f"{leaf.pixels.size} px" in nodes[f"P{leaf.name}"]
    for segment in merged.tree.segments:
        # A segment that was divided at a gap has no value.
        assert ("mse " in nodes[f"P{segment.name}"]) == ("mse" in segment.fit.values)


def test_graphviz_draws_the_graph(merged: FrameResult) -> None:
    dot = shutil.which("dot")
    if dot is None:
        pytest.skip("Graphviz is not installed (apt-get install graphviz)")
    graph = tree_graph(merged, "mse").encode()
    plain = subprocess.run([dot, "-Tplain"], input=graph, capture_output=True, check=True, timeout=60).stdout
    kinds = [line.split()[0] for line in plain.decode().splitlines()]
    assert kinds.count("node") == len(merged.tree.segments)
    assert kinds.count("edge") == len(merged.tree.segments) - 1


def test_each_value_is_of_the_frame_that_it_was_measured_in(merged: FrameResult) -> None:
    carried, unmeasured, *_ = [segment for segment in merged.tree.segments if segment.fit.values]
    changed = {
        carried.name: replace(carried, measured=3, judged=4),
        unmeasured.name: replace(unmeasured, fit=replace(unmeasured.fit, values={})),
    }
    segments = tuple(changed.get(segment.name, segment) for segment in merged.tree.segments)
    frame = replace(merged.frame, index=7)
    result = replace(merged, frame=frame, tree=replace(merged.tree, segments=segments))
    documents = dict(zip(segments, tree_document(result, "mse")["segments"], strict=True))
    assert len(documents) > 5
    for each, document in documents.items():
        of_frame = 3 if each.name == carried.name else 7
        assert document["measured"] == (of_frame if each.fit.values else None)
        assert document["judged"] == (4 if each.name == carried.name else 7)
