"""Draw collapsed stacks as a flame graph: an SVG without a script, which any browser shows.

Examples
--------
One line for each stack, its frames from the outermost on, parted by semicolons, then a
count; so py-spy writes them::

    py-spy record -r 250 -f raw -o stacks.txt -- python benchmarks/stability.py FOLDER --every 200
    python benchmarks/flame_graph.py stacks.txt flame.svg --below Segmenter.process
"""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import escape

WIDTH, ROW = 1600, 17
#: Boxes narrower than this many pixels are left out; names need this many pixels a letter.
NARROWEST, LETTER = 1.2, 6.4
COLORS = ("#f4a259", "#f6bd60", "#ee9b5f", "#f2b880", "#e9a03b", "#f7c873")


@dataclass
class Box:
    """A function in its place of the stacks, with the samples that were taken in it or below."""

    name: str
    samples: int = 0
    inner: dict[str, Box] = field(default_factory=dict)


def read_stacks(text: str, below: str) -> Box:
    """Return the stacks as a tree; those that pass through a function named `below`, from it on."""
    root = Box("all")
    for line in text.splitlines():
        stack, _, count = line.rpartition(" ")
        names = [shortened(frame) for frame in stack.split(";")]
        if below:
            place = next((n for n, name in enumerate(names) if name.startswith(f"{below} ")), None)
            if place is None:
                continue
            names = names[place:]
        box = root
        box.samples += int(count)
        for name in names:
            box = box.inner.setdefault(name, Box(name))
            box.samples += int(count)
    return root


def shortened(frame: str) -> str:
    """Return a frame as ``function (file)``, without folders and line."""
    found = re.fullmatch(r"(.*) \((?:.*/)?([^/:]+)(?::\d+)?\)", frame.strip())
    return f"{found[1]} ({found[2]})" if found else frame.strip()


def drawn(root: Box) -> str:
    """Return the SVG."""
    boxes: list[str] = []
    deepest = 0

    def draw(box: Box, left: float, depth: int) -> None:
        nonlocal deepest
        width = WIDTH * box.samples / root.samples
        if width < NARROWEST:
            return
        deepest = max(deepest, depth)
        share = f"{100 * box.samples / root.samples:.1f} %"
        color = COLORS[sum(map(ord, box.name)) % len(COLORS)]
        name = box.name if len(box.name) * LETTER < width else box.name[: max(0, int(width / LETTER) - 1)]
        at = f'x="{left:.1f}" y="{depth * ROW}"'
        label = f'<text x="{left + 3:.1f}" y="{depth * ROW + 12}">{escape(name)}</text>'
        boxes.append(
            f"<g><title>{escape(box.name)}: {share}</title>"
            f'<rect {at} width="{max(width - 0.5, 0.5):.1f}" height="{ROW - 1}" fill="{color}"/>'
            f"{label if len(name) > 2 else ''}</g>"
        )
        for each in sorted(box.inner.values(), key=lambda inner: -inner.samples):
            draw(each, left, depth + 1)
            left += WIDTH * each.samples / root.samples

    draw(root, 0.0, 0)
    height = (deepest + 1) * ROW
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" '
        f'height="{height}" font-family="monospace" font-size="10.5">\n'
        f'<rect width="{WIDTH}" height="{height}" fill="#fffdf7"/>\n' + "\n".join(boxes) + "\n</svg>\n"
    )


def main() -> None:
    """Read the stacks and write the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("stacks", type=Path, help="collapsed stacks")
    parser.add_argument("picture", type=Path, help="SVG to write")
    parser.add_argument("--below", default="", help="function that is drawn, with what it calls (all)")
    arguments = parser.parse_args()
    root = read_stacks(arguments.stacks.read_text(), arguments.below)
    if root.samples == 0:
        raise SystemExit(f"{arguments.stacks}: no stack passes through {arguments.below!r}")
    arguments.picture.write_text(drawn(root))


if __name__ == "__main__":
    main()
