"""A step as one SVG picture."""

import base64
from collections.abc import Sequence
from html import escape
from textwrap import wrap

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.library.explanation.panels import WIDTH, Panels, part_colors
from nurbseg.library.explanation.steps import Part, Step
from nurbseg.library.explanation.tree import marks, tree_svg
from nurbseg.library.palette import residual_colors
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.surfaces.metrics import COUNTS
from nurbseg.segmentation.vocabulary import display_name

#: Size of a picture, of its margins, and of the gaps between its parts.
_SIZE, _EDGE, _GAP = (1440, 900), 36, 24
_JPEG_QUALITY = 88
_STYLE = (
    "text{font-family:Inter,'Segoe UI','Helvetica Neue',Arial,sans-serif;fill:#e8ebf0}"
    ".small{font-size:15px;fill:#98a1ae}.told{font-size:30px;font-weight:600}.caption{font-size:16px}"
    ".value{font-size:15px;fill:#c3cad4}.name{font-size:11.5px;text-anchor:middle;fill:#98a1ae;paint-order:stroke;stroke:#14171c;stroke-width:4px}"
    ".strong{fill:#fff;font-weight:600}.edge{fill:none;stroke:#59626f;stroke-width:1.3}.faint{opacity:.22}"
    ".ring{fill:none;stroke:#fff;stroke-width:2}.limit{stroke:#fff;stroke-width:1.5;stroke-dasharray:4 3}"
)
_CAPTIONS = {
    "cut": ("two sides of a cut", "one surface", "a surface for each part"),
    "gap": ("components", "the whole", "a surface for each component"),
    "crease": ("what meets in a crease", "one surface", "a surface for each part"),
    "protrusion": ("what stands in front", "one surface", "a surface for each part"),
    "fold": ("two parts that meet smoothly", "one surface for both", "a surface for each part"),
    "merge": ("surfaces of one object", "the object", "its surfaces"),
}


def picture(step: Step, drawn: Panels, tree: SegmentationTree, steps: Sequence[Step], title: str) -> str:
    """Return a step as an SVG picture that needs no other file.

    Parameters
    ----------
    step, drawn : Step, Panels
        The step, and its pictures.
    tree, steps : SegmentationTree, sequence of Step
        The tree, and all its steps.
    title : str
        What was segmented, and how.
    """
    width, height = _SIZE
    each = (width - 2 * _EDGE - 2 * _GAP) / 3
    high = min(each * drawn.sides.shape[0] / WIDTH, 400.0)
    told = wrap(step.sentence[0].upper() + step.sentence[1:], 84)[:2]
    top = 108.0 + 36.0 * len(told)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{escape(step.sentence)}"><style>{_STYLE}</style>'
        f'<rect width="{width}" height="{height}" fill="#14171c"/>',
        _text(_EDGE, 46, "small", f"Step {step.number} of {len(steps)} · {_subject(step)}"),
        _text(width - _EDGE, 46, "small", title, "end"),
        *(_text(_EDGE, 92 + 38 * line, "told", text) for line, text in enumerate(told)),
    ]
    images = (drawn.sides, drawn.whole, drawn.parts)
    for column, (image, caption) in enumerate(zip(images, _CAPTIONS[step.kind], strict=True)):
        x = _EDGE + column * (each + _GAP)
        parts.append(_text(x, top - 8, "caption", caption))
        parts.append(
            f'<image x="{x:.1f}" y="{top:.1f}" width="{each:.1f}" height="{high:.1f}" '
            f'preserveAspectRatio="xMidYMid slice" href="{_jpeg(image)}"/>'
        )
    parts.append(_scale(width - _EDGE - 220, top + high + 12, drawn.largest_m))
    below = top + high + 56
    parts.append(f'<g transform="translate({_EDGE},{below:.1f})">{_figures(step)}</g>')
    left = _EDGE + each + _GAP
    grown = tree_svg(*marks(tree, steps, step, width - _EDGE - left, height - below - 16))
    parts.append(f'<g transform="translate({left:.1f},{below:.1f})">{grown}</g></svg>')
    return "".join(parts)


def _subject(step: Step) -> str:
    if step.kind == "merge":
        return f"surfaces {', '.join(display_name(part.name or '') for part in step.parts)}"[:90]
    return f"segment {display_name(step.name)}, depth {step.depth}"


def _figures(step: Step) -> str:
    """Return the metric of the whole and of the parts as bars, or the evidence for an object."""
    if step.kind == "merge":
        lines = [line for each in step.evidence[:4] for line in wrap(each, 56)]
        return "".join(_text(0, 10 + 24 * row, "value", text) for row, text in enumerate(lines))
    rows = [_row(part, color, step) for part, color in zip(step.parts, part_colors(step), strict=True)][:5]
    listed = "".join(f'<g transform="translate(0,{112 + 28 * n})">{row}</g>' for n, row in enumerate(rows))
    if len(step.parts) > len(rows):
        listed += _text(22, 112 + 28 * len(rows), "value", f"and {len(step.parts) - len(rows)} more")
    if step.ratio is None or not np.isfinite(step.ratio) or step.whole.value is None:
        return f'<g transform="translate(0,-102)">{listed}</g>'
    room, largest = 420.0, max(1.0, step.ratio, step.ratio_max)
    unit = room / (1.04 * largest)
    bars, x = [], 0.0
    sizes = [(part.value or 0.0) * (1 if step.metric in COUNTS else part.points) for part in step.parts]
    for size, (red, green, blue) in zip(sizes, part_colors(step), strict=True):
        long = unit * step.ratio * size / max(sum(sizes), 1e-300)
        bars.append(
            f'<rect x="{x:.1f}" y="34" width="{long:.1f}" height="18" fill="rgb({red},{green},{blue})"/>'
        )
        x += long
    limit = unit * step.ratio_max
    whole = f"{step.metric.upper()} of one surface: {step.whole.told(step.metric)}"
    return (
        f"{_text(0, 0, 'value', whole)}"
        f'<rect x="0" y="12" width="{unit:.1f}" height="18" fill="#aab2bd"/>{"".join(bars)}'
        f'<path d="M{limit:.1f} 6V60" class="limit"/>{_text(limit + 6, 62, "small", "T")}'
        f"{_text(0, 82, 'caption', step.verdict)}{listed}"
    )


def _row(part: Part, color: tuple[int, int, int], step: Step) -> str:
    red, green, blue = color
    name = "" if part.name is None else f"{display_name(part.name)}: "
    return (
        f'<rect y="-12" width="14" height="14" rx="3" fill="rgb({red},{green},{blue})"/>'
        f"{_text(22, 0, 'value', name + part.told(step.metric))}"
    )


def _scale(x: float, y: float, largest_m: float) -> str:
    values = np.linspace(0.0, 1.0, 12)
    colors = [f"#{int(color) >> 8:06x}" for color in residual_colors(values, 1.0)]
    stops = "".join(
        f'<rect x="{x + 12 * n}" y="{y}" width="12.5" height="10" fill="{c}"/>' for n, c in enumerate(colors)
    )
    ends = (
        _text(x - 8, y + 10, "small", "0", "end"),
        _text(x + 152, y + 10, "small", f"{1e3 * largest_m:g} mm"),
    )
    return stops + "".join(ends)


def _text(x: float, y: float, kind: str, text: str, anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{kind}" text-anchor="{anchor}">{escape(text)}</text>'


def _jpeg(image: NDArray[np.uint8]) -> str:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}"
