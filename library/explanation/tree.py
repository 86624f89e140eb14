"""The tree of a frame as it is drawn at a step: as far as it has grown."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from nurbseg.library.explanation.panels import RGB, part_colors
from nurbseg.library.explanation.steps import Step, children_in_steps
from nurbseg.library.explanation.words import compared
from nurbseg.library.palette import DIVISION_COLORS, STOPS
from nurbseg.library.tree_layout import fitted, tree_positions
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.vocabulary import Division, display_name

#: Distance of neighbors and of levels in small trees, radii of nodes, and height and width of a letter.
_SPACING, _LEVEL, _RADIUS, _LEAST = 92.0, 74.0, 9.0, 3.5
_LETTER_HEIGHT, _LETTER_WIDTH = 12.0, 7.4
#: Room above the root and below the deepest leaves.
_ABOVE, _BELOW = 8.0, 26.0


@dataclass(frozen=True, slots=True)
class Mark:
    """A node as it is drawn."""

    name: str
    x: float
    y: float
    radius: float
    color: RGB
    #: Its name and ratio; empty where there is no room.
    label: str
    #: Whether the step is of it, it is one of the step's parts, and it is in the tree by then.
    is_now: bool
    is_part: bool
    is_there: bool
    #: What was decided on it.
    told: str
    #: Number of its step; None if it has none.
    step: int | None


def marks(
    tree: SegmentationTree, steps: Sequence[Step], now: Step, width: float, height: float
) -> tuple[list[Mark], list[tuple[Mark, Mark]]]:
    """Return the nodes of a tree, and its edges, each from a segment to a part.

    Parameters
    ----------
    tree : SegmentationTree
        The tree; nodes that only chain parts are left out.
    steps : sequence of Step
        Of the tree.
    now : Step
        One of them. Its parts have their colors, and what is decided later is not there yet.
    width, height : float
        Size of the drawing; y points down.
    """
    children = children_in_steps(tree)
    positions = tree_positions(children, "")
    places, spacing = fitted([*positions.values()], width, height - _BELOW, _SPACING, _LEVEL)
    at = {name: (float(x), float(y) + _ABOVE) for name, (x, y) in zip(positions, places, strict=True)}
    radius = max(_LEAST, min(_RADIUS, 0.38 * spacing))
    step_of = {step.name: step for step in steps if step.kind != "merge"}
    colors = zip(now.parts, part_colors(now), strict=True)
    colored = {part.name: color for part, color in colors if part.name is not None}
    labels = _labels(at, radius, step_of, now, colored)
    there = {""}
    for name, parts in children.items():
        if name in there and (name not in step_of or step_of[name].number <= now.number):
            there.update(parts)
    found = {
        name: Mark(
            name=name,
            x=x,
            y=y,
            radius=radius,
            color=colored.get(name, _fill(tree[name])),
            label=labels.get(name, ""),
            is_now=name == now.name and now.kind != "merge",
            is_part=name in colored,
            is_there=name in there,
            told=_told(tree[name], step_of),
            step=step_of[name].number if name in step_of else None,
        )
        for name, (x, y) in at.items()
    }
    edges = [(found[name], found[part]) for name, parts in children.items() for part in parts]
    return [*found.values()], edges


def tree_svg(nodes: Iterable[Mark], edges: Iterable[tuple[Mark, Mark]]) -> str:
    """Return a tree as elements of an SVG picture; what is not there yet is faint."""
    lines = []
    for one, part in edges:
        middle = (one.y + part.y) / 2
        bend = f"C{one.x:.1f} {middle:.1f} {part.x:.1f} {middle:.1f} {part.x:.1f} {part.y:.1f}"
        faint = "" if part.is_there else " faint"
        lines.append(f'<path d="M{one.x:.1f} {one.y:.1f}{bend}" class="edge{faint}"/>')
    circles, texts = [], []
    for node in nodes:
        place, (red, green, blue) = f'cx="{node.x:.1f}" cy="{node.y:.1f}"', node.color
        ring = f'<circle {place} r="{node.radius + 4:.1f}" class="ring"/>' if node.is_now else ""
        jump = "" if node.step is None else f' data-step="{node.step}"'
        circles.append(
            f'<g class="{"" if node.is_there else "faint"}"{jump}><title>{escape(node.told)}</title>{ring}'
            f'<circle {place} r="{node.radius:.1f}" fill="rgb({red},{green},{blue})"/></g>'
        )
        strong = " strong" if node.is_now or node.is_part else "" if node.is_there else " faint"
        y = node.y + node.radius + _LETTER_HEIGHT
        texts.append(f'<text x="{node.x:.1f}" y="{y:.1f}" class="name{strong}">{node.label}</text>')
    return "".join((*lines, *circles, *texts))


def _fill(segment: Segment) -> RGB:
    return DIVISION_COLORS[Division.CUT] if segment.stop is None else STOPS[segment.stop][0]


def _told(segment: Segment, step_of: Mapping[str, Step]) -> str:
    """Return what is decided on a node, for the pointer above it."""
    told = [f"{display_name(segment.name)}, {segment.pixels.size:,} pixels"]
    if segment.name in step_of:
        told.append(step_of[segment.name].sentence)
    if segment.stop is not None:
        told.append(STOPS[segment.stop][1].partition(": ")[2])
    return "; ".join(told)


def _labels(
    at: Mapping[str, tuple[float, float]],
    radius: float,
    step_of: Mapping[str, Step],
    now: Step,
    colored: Mapping[str, RGB],
) -> dict[str, str]:
    """Return names and ratios of nodes, as far as there is room; those of the step come first."""
    taken: list[tuple[float, float, float]] = []
    labels = {}

    def by_importance(name: str) -> tuple[bool, bool, bool, int]:
        return name != now.name, name not in colored, name not in step_of, len(name)

    for name in sorted(at, key=by_importance):
        text, step = display_name(name), step_of.get(name)
        if step is not None and step.ratio is not None and step.number <= now.number:
            text += f" {compared(step.ratio, step.ratio_max)}"
        (x, y), half = at[name], 0.5 * _LETTER_WIDTH * len(text) + 2.0
        if all(abs(y - b) > _LETTER_HEIGHT + radius or abs(x - a) > half + c for a, b, c in taken):
            taken.append((x, y, half))
            labels[name] = text
    return labels
