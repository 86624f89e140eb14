"""A figure of a frame of a finished study for a paper: outlines and a tree as vectors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.files import read_json, write_atomically
from nurbseg.common.kept_code import left_out
from nurbseg.drivers.options import SourceOptions
from nurbseg.evaluation.report.pictures import matched_colors
from nurbseg.evaluation.report.plots import draw_tree
from nurbseg.evaluation.results import VARIANTS_FILE
from nurbseg.evaluation.study import FrameRef, read_frame
from nurbseg.evaluation.truth import ground_truth
from nurbseg.segmentation.points.registration import register

#: Width of a figure of one column and of two, and height of a level of the tree, inches; size of letters.
_WIDTH_IN = {1: 85 / 25.4, 2: 174 / 25.4}
_LEVEL_IN, _POINTS = 0.22, 6.5


@dataclass(frozen=True, slots=True)
class _Shown:
    """A variant that is drawn."""

    name: str
    key: str
    gtrc: float


def write_figure(
    folder: Path, wanted: str, path: Path, *, columns: int, variants: Sequence[str] = ()
) -> None:
    """Draw the outlines of the ground truth and of segmentations on a frame's photo, and a tree below.

    Parameters
    ----------
    folder : Path
        Of the study.
    wanted : str
        The frame's name, or its index in its source.
    path : Path
        The figure; its ending chooses the format, such as ``.pdf`` or ``.svg``.
    columns : int
        1 for a width of 85 mm, 2 for 174 mm.
    variants : sequence of str
        Names of variants to draw, by default the best of each method.

    Raises
    ------
    ValueError
        If the study, the frame or a variant does not exist, or the format is unknown.
    """
    with left_out():
        import matplotlib as mpl
        from matplotlib.figure import Figure

    study, frame = _study(folder), _frame(folder, wanted)
    shown = _shown(folder, frame, variants)
    read = read_frame(FrameRef(frame["uri"], frame["index"], frame["key"]), _options(study))
    cloud = register(read)
    if read.labels is None:
        raise ValueError(f"{frame['uri']}: frame {frame['name']} no longer has ground truth")
    truth = np.where(cloud.valid, ground_truth(read.labels, study["truth"], study["pieces"]), 0)
    panels: list[tuple[str, NDArray[Any]]] = [("ground truth", truth)]
    for each in shown:
        labels = cv2.imread(str(folder / "labels" / each.key / f"{frame['key']}.png"), cv2.IMREAD_UNCHANGED)
        if labels is None:
            raise ValueError(f"{folder}: no labels of {each.name} for frame {frame['name']}")
        panels.append((f"{each.name}\nGTRC {each.gtrc:.3f}", np.where(cloud.valid, labels, 0)))
    trees = (folder / "trees" / each.key / f"{frame['key']}.json" for each in shown)
    segments: list[dict[str, Any]] = next(
        (read_json(tree)["segments"] for tree in trees if tree.exists()), []
    )
    # Letters remain letters, and the same figure is the same file.
    with mpl.rc_context({"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "nurbseg"}):
        across = min(len(panels), 2 * columns)
        rows = -(-len(panels) // across)
        width = _WIDTH_IN[columns]
        tile = width / across * truth.shape[0] / truth.shape[1] + 0.26
        levels = max((len(segment["name"]) for segment in segments), default=-1) + 1
        heights = [tile] * rows + [_LEVEL_IN * (levels + 2)] * bool(segments)
        figure = Figure(figsize=(width, sum(heights)), layout="constrained")
        grid = figure.add_gridspec(len(heights), across, height_ratios=heights)
        for place, (caption, labels) in enumerate(panels):
            axis = figure.add_subplot(grid[divmod(place, across)])
            axis.imshow(cloud.color, interpolation="nearest")
            _outline(axis, labels, truth)
            axis.set_title(caption, fontsize=_POINTS, pad=2)
            axis.set_axis_off()
        if segments:
            draw_tree(figure.add_subplot(grid[rows, :]), segments, dot=16.0, font=_POINTS - 2)
        content = BytesIO()
        form = path.suffix.removeprefix(".")
        dated = {"pdf": "CreationDate", "svg": "Date"}.get(form)
        figure.savefig(content, format=form, dpi=300, metadata={dated: None} if dated else None)
    write_atomically(path, content.getvalue())


def _outline(axis: Any, labels: NDArray[Any], truth: NDArray[Any]) -> None:
    """Draw the border of each segment but the largest, in the color of the region that it is matched to."""
    colors = matched_colors(labels, truth)
    largest = int(np.bincount(labels[labels > 0]).argmax()) if labels.any() else 0
    for value, color in colors.items():
        if value != largest:
            # Midway between pixels inside and outside, also at the image's edge.
            inside = np.pad((labels == value).astype(float), 1)
            rows, columns = (np.arange(-1, size + 1) for size in labels.shape)
            axis.contour(columns, rows, inside, [0.5], colors=[np.array(color) / 255], linewidths=0.7)
    axis.set(xlim=(-0.5, labels.shape[1] - 0.5), ylim=(labels.shape[0] - 0.5, -0.5))


def _study(folder: Path) -> dict[str, Any]:
    try:
        return read_json(folder / "study.json")
    except FileNotFoundError as err:
        raise ValueError(f"{err}: expected a folder that nurbseg-eval run --out wrote") from err


def _options(study: Mapping[str, Any]) -> SourceOptions:
    given = dict(study["options"])
    if given["intrinsics"] is not None:
        given["intrinsics"] = tuple(given["intrinsics"])
    if "calibration" in given:
        # Its content follows in parentheses.
        given["calibration"] = Path(given["calibration"].rpartition(" (")[0])
    return SourceOptions(**given)


def _frame(folder: Path, wanted: str) -> dict[str, Any]:
    frames = [read_json(path) | {"key": path.stem} for path in sorted((folder / "frames").glob("*.json"))]
    frames = [frame for frame in frames if not frame.get("skipped")]
    found = [frame for frame in frames if frame["name"] == wanted]
    found = found or [frame for frame in frames if str(frame["index"]) == wanted]
    if len(found) != 1:
        names = ", ".join(each["name"] for each in found or frames)
        what = "several frames have this index" if found else "no such frame"
        raise ValueError(f"--frame {wanted}: {what}; expected one of {names}")
    return found[0]


def _shown(folder: Path, frame: Mapping[str, Any], wanted: Sequence[str]) -> list[_Shown]:
    """Return the variants to draw: those of these names, or the one with the best GTRC of each method."""
    known = read_json(folder / VARIANTS_FILE)
    keys = [key for key in known if key in frame["results"]]
    if wanted:
        by_name = {known[key]["name"]: key for key in keys}
        if missing := [each for each in wanted if each not in by_name]:
            raise ValueError(f"--variant {missing[0]}: expected one of {', '.join(by_name)}")
        keys = [by_name[each] for each in wanted]
    else:
        best: dict[str, str] = {}
        for key in sorted(keys, key=lambda key: -known[key]["gtrc"]):
            best.setdefault(known[key]["method"], key)
        keys = [key for key in keys if key in best.values()]
    return [_Shown(known[key]["name"], key, frame["results"][key]["gtrc"]) for key in keys]
