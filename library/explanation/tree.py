"""The tree of a frame as SVG, as far as it has grown at a step."""

from collections.abc import Mapping, Sequence
from html import escape

from nurbseg.library.explanation.panels import RGB, part_colors
from nurbseg.library.explanation.steps import Step, children_in_steps
from nurbseg.library.explanation.words import compared
from nurbseg.library.palette import STOPS
from nurbseg.library.tree_layout import fitted, tree_positions
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.vocabulary import display_name

#: Distance of neighbors and of levels in small trees, radii of nodes, and height and width of a letter.
_SPACING, _LEVEL, _RADIUS, _LEAST = 92.0, 74.0, 9.0, 3.5
_LETTER_HEIGHT, _LETTER_WIDTH = 12.0, 7.4


def tree_svg(tree: SegmentationTree, steps: Sequence[Step], now: Step, width: float, height: float) -> str:
    """Return the tree: what is decided in full colors, what is still to come faint.

    Parameters
    ----------
    tree : SegmentationTree
        The tree; nodes that only chain parts are left out.
    steps : sequence of Step
        Of the tree.
    now : Step
        One of them. Its node has a ring, and its parts have their colors.
    width, height : float
        Size of the drawing.
    """
    children = children_in_steps(tree)
    positions = tree_positions(children, "")
    places, spacing = fitted([*positions.values()], width, height - 26.0, _SPACING, _LEVEL)
    at = {name: (float(x), float(y) + 8.0) for name, (x, y) in zip(positions, places, strict=True)}
    radius = max(_LEAST, min(_RADIUS, 0.38 * spacing))
    step_of = {each.name: each for each in steps if each.kind != "merge"}
    colored: dict[str, RGB] = {
        part.name: color
        for part, color in zip(now.parts, part_colors(now), strict=True)
        if part.name is not None
    }
    is_over = {name: step_of[name].number <= now.number for name in step_of}
    lines, nodes = [], []
    for name, parts in children.items():
        drawn = is_over.get(name, True)
        for part in parts:
            (x0, y0), (x1, y1), middle = at[name], at[part], (at[name][1] + at[part][1]) / 2
            path = f"M{x0:.1f} {y0:.1f}C{x0:.1f} {middle:.1f} {x1:.1f} {middle:.1f} {x1:.1f} {y1:.1f}"
            lines.append(f'<path d="{path}" class="{"edge" if drawn else "edge faint"}"/>')
    for name, (x, y) in at.items():
        segment = tree[name]
        fill, has_come = _fill(segment), is_over.get(name, True) and _is_there(name, children, is_over)
        own = colored.get(name)
        ring = (
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius + 4:.1f}" class="ring"/>'
            if name == now.name and now.kind != "merge"
            else ""
        )
        red, green, blue = own or fill
        jump = f' data-step="{step_of[name].number}"' if name in step_of else ""
        nodes.append(
            f'<g class="node{"" if has_come or own else " faint"}"{jump}>'
            f"<title>{escape(_told(segment, step_of))}</title>{ring}"
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="rgb({red},{green},{blue})"/></g>'
        )
    return "".join((*lines, *nodes, *_labels(at, radius, step_of, now, colored)))


def _is_there(name: str, children: Mapping[str, Sequence[str]], is_over: Mapping[str, bool]) -> bool:
    """Whether all divisions above a node were made."""
    return all(is_over.get(name[:end], True) for end in range(len(name)) if name[:end] in children)


def _fill(segment: Segment) -> RGB:
    return (150, 155, 162) if segment.stop is None else STOPS[segment.stop][0]


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
) -> list[str]:
    """Return names and ratios of nodes, as far as there is room; those of the step come first."""
    taken: list[tuple[float, float, float]] = []
    texts = []
    for name in sorted(
        at, key=lambda each: (each != now.name, each not in colored, each not in step_of, len(each))
    ):
        step = step_of.get(name)
        is_told = step is not None and step.number <= now.number and step.ratio is not None
        ratio = (
            f" {compared(step.ratio, step.ratio_max)}" if is_told and step and step.ratio is not None else ""
        )
        text = display_name(name) + ratio
        (x, y), half = at[name], 0.5 * _LETTER_WIDTH * len(text) + 2.0
        y += radius + _LETTER_HEIGHT
        free = all(abs(y - b) > _LETTER_HEIGHT or abs(x - a) > half + c for a, b, c in taken)
        # A name of a node that is on no step yet would hide those of more importance.
        if not free:
            continue
        taken.append((x, y, half))
        strong = name == now.name or name in colored
        texts.append(f'<text x="{x:.1f}" y="{y:.1f}" class="name{" strong" if strong else ""}">{text}</text>')
    return texts
