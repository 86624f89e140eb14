"""The steps of a frame as one HTML page, which needs no other file or host."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.explanation.panels import Panels, data_uri, part_colors
from nurbseg.library.explanation.steps import Step, children_in_steps
from nurbseg.library.explanation.words import compared
from nurbseg.library.palette import DIVISION_COLORS, STOPS, label_color
from nurbseg.library.tree_layout import fitted, tree_positions
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.metrics import COUNTS
from nurbseg.segmentation.vocabulary import Division, display_name

#: Size of the tree's drawing, the distance of neighbors and of levels in small trees, and radii of nodes.
_WIDTH, _HEIGHT, _SPACING, _LEVEL, _RADIUS, _LEAST = 860.0, 380.0, 92.0, 74.0, 9.0, 3.5
#: Room above the root and below the deepest leaves.
_ABOVE, _BELOW = 16.0, 34.0


class _Node(NamedTuple):
    """A node of the tree as it is drawn: `step` judges it, `born` is the step that adds it."""

    name: str
    x: float
    y: float
    ratio: str
    color: str
    summary: str
    step: int | None
    born: int


def page(
    title: str,
    tree: SegmentationTree,
    steps: Sequence[tuple[Step, Panels]],
    picture: NDArray[np.uint8],
    step_of_object: Mapping[int, int],
) -> str:
    """Return the page of an explanation, whose fields these are."""
    from jinja2 import Environment, StrictUndefined  # late: nothing else in a run needs it

    source = files("nurbseg.library.explanation").joinpath("page.html.j2").read_text(encoding="utf-8")
    made = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters |= {"css": _css, "display": lambda name: display_name(name or ""), "jpeg": data_uri}
    return made.from_string(source).render(
        title=title,
        picture=picture,
        objects=[(label, label_color(label), step) for label, step in sorted(step_of_object.items())],
        steps=((step, drawn, part_colors(step), _bar(step)) for step, drawn in steps),
        count=len(steps),
        tree=(*_nodes(tree, [step for step, _ in steps]), _WIDTH, _HEIGHT),
    )


def _bar(step: Step) -> dict[str, Any] | None:
    """Return widths, in percent: of one surface, of each part, and of T; None where no ratio decides."""
    if step.ratio is None or not np.isfinite(step.ratio) or step.whole.value is None:
        return None
    unit = 96.0 / max(1.0, step.ratio, step.ratio_max)
    sizes = [(part.value or 0.0) * (1 if step.metric in COUNTS else part.points) for part in step.parts]
    shares = [unit * step.ratio * size / max(sum(sizes), 1e-300) for size in sizes]
    return {"whole": unit, "parts": shares, "limit": unit * step.ratio_max}


def _nodes(
    tree: SegmentationTree, steps: Sequence[Step]
) -> tuple[list[_Node], list[tuple[_Node, _Node]], float]:
    """Return the nodes of a tree but for mere chains, its edges, and the radius of a node."""
    children = children_in_steps(tree)
    positions = tree_positions(children, "")
    places, spacing = fitted([*positions.values()], _WIDTH, _HEIGHT - _BELOW, _SPACING, _LEVEL)
    step_of = {step.name: step for step in steps if step.kind != "merge"}
    born, nodes = {"": 0}, {}
    for name, (x, y) in zip(positions, places.tolist(), strict=True):
        step = step_of.get(name)
        for part in children[name]:
            born[part] = max(born[name], 0 if step is None else step.number)
        ratio = "" if step is None or step.ratio is None else compared(step.ratio, step.ratio_max)
        nodes[name] = _Node(name, x, y + _ABOVE, ratio, *_look(tree[name], step), born[name])
    edges = [(nodes[name], nodes[part]) for name, parts in children.items() for part in parts]
    return [*nodes.values()], edges, max(_LEAST, min(_RADIUS, 0.38 * spacing))


def _look(segment: Segment, step: Step | None) -> tuple[str, str, int | None]:
    """Return the color of a node, the decisions on it, and the number of its step."""
    color = DIVISION_COLORS[Division.CUT] if segment.stop is None else STOPS[segment.stop][0]
    lines = [f"{display_name(segment.name)}, {segment.pixels.size:,} pixels"]
    lines += [] if step is None else [step.sentence]
    lines += [] if segment.stop is None else [STOPS[segment.stop][1].partition(": ")[2]]
    return _css(color), "; ".join(lines), None if step is None else step.number


def _css(color: Sequence[int]) -> str:
    return f"rgb({','.join(str(int(value)) for value in color)})"
