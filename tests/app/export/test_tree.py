"""The tree as a graph, read by Graphviz."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest

from nurbseg.app.export.tree import tree_graph
from nurbseg.app.result import FrameResult


def test_the_graph_has_every_segment_and_its_children(merged: FrameResult) -> None:
    graph = tree_graph(merged, "mse")
    nodes = dict(re.findall(r"^  (P[01]*) \[label=\"(.*)\"\];$", graph, re.MULTILINE))
    assert set(nodes) == {f"P{each.name}" for each in merged.tree.segments}
    edges = re.findall(r"^  (P[01]*) -> (P[01]*);$", graph, re.MULTILINE)
    assert sorted(edges) == sorted(
        (f"P{each.name}", f"P{child}") for each in merged.tree.segments for child in each.children
    )
    for each in merged.objects:
        assert all(f"object {each.label}" in nodes[f"P{name}"].split("\\n") for name in each.leaves)
    for leaf in merged.tree.leaves():
        assert leaf.stop is not None
        assert leaf.stop.value in nodes[f"P{leaf.name}"]
        assert f"{leaf.pixels.size} px" in nodes[f"P{leaf.name}"]
    for each in merged.tree.segments:
        # A segment that was divided at a gap has no value.
        assert ("mse " in nodes[f"P{each.name}"]) == ("mse" in each.fit.values)


def test_graphviz_draws_the_graph(merged: FrameResult) -> None:
    dot = shutil.which("dot")
    if dot is None:
        pytest.skip("Graphviz is not installed (apt-get install graphviz)")
    graph = tree_graph(merged, "mse").encode()
    plain = subprocess.run([dot, "-Tplain"], input=graph, capture_output=True, check=True, timeout=60).stdout
    kinds = [line.split()[0] for line in plain.decode().splitlines()]
    assert kinds.count("node") == len(merged.tree.segments)
    assert kinds.count("edge") == len(merged.tree.segments) - 1
