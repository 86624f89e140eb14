"""The report of a study: a self-contained HTML file, and its pictures as PNG."""

import base64
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.computer import versions_line
from nurbseg.common.files import read_json, write_atomically
from nurbseg.evaluation.answers import Answers
from nurbseg.evaluation.report import pictures, plots
from nurbseg.evaluation.report.findings import conclusions, joint_rows
from nurbseg.evaluation.results import StudyResults, StudyStore
from nurbseg.evaluation.study import FrameRef, Study, label_path, read_frame, tree_path
from nurbseg.evaluation.truth import TRUTHS, ground_truth
from nurbseg.evaluation.variants import TREE_METHODS, Variant
from nurbseg.library.palette import STOP_COLORS
from nurbseg.segmentation.points.grid import grid_step
from nurbseg.segmentation.points.registration import register
from nurbseg.segmentation.segments import Segment, SegmentationTree

_TILE_PX = 480
#: Number of the worst and of the best frames whose trees and fits are drawn.
_TREES = 3
#: Residual that is drawn in red, meters.
_ERROR_M = 0.05


def write_report(
    study: Study,
    store: StudyStore,
    results: StudyResults,
    seconds: Mapping[str, float],
    *,
    title: str,
    command: str,
    frames_shown: int,
) -> Path:
    """Write ``report.html`` and ``pictures/*.png`` to the study's folder; return the path of the former.

    It shows at most `frames_shown` of the worst frames. `seconds` is the time per frame by variant.
    """
    import jinja2

    folder = store.folder / "pictures"
    folder.mkdir(exist_ok=True)
    shown = results.leaders()
    best = max(shown, key=lambda each: results.mean(each, "gtrc"))
    image = plots.threshold_plot(results)
    drawn_plots = [] if image is None else [("Scores against T", _saved(folder / "threshold.png", image))]
    trees_of = next((each for each in shown if each.method in TREE_METHODS), None)
    source = Path(__file__).with_name("report.html.j2").read_text(encoding="utf-8")
    template = jinja2.Template(source, autoescape=True)
    html = template.render(
        title=title,
        command=command,
        date=datetime.now(UTC).date(),
        versions=versions_line(),
        results=results,
        truth=TRUTHS[study.truth],
        findings=conclusions(results),
        leaders=joint_rows(results, shown, seconds),
        variants=joint_rows(results, results.variants, seconds),
        plots=drawn_plots,
        leader=best.name,
        pictures=[
            _frame_pictures(study, store, frame, shown, best, folder)
            for frame in results.worst_frames(best)[:frames_shown]
        ],
        trees=[] if trees_of is None else _tree_pictures(study, store, results, trees_of, folder),
        stops=[(stop.value, plots.stop_color(stop)) for stop in STOP_COLORS],
    )
    path = store.folder / "report.html"
    write_atomically(path, html.encode())
    return path


def _frame_pictures(
    study: Study,
    store: StudyStore,
    frame: Mapping[str, Any],
    variants: Sequence[Variant],
    best: Variant,
    folder: Path,
) -> dict[str, Any]:
    """Draw color, depth, ground truth and each variant's labels of a frame side by side."""
    read = read_frame(FrameRef(frame["uri"], frame["index"], frame["key"]), study.options)
    cloud = register(read)
    if read.labels is None:
        raise ValueError(f"{frame['uri']}: frame {frame['name']} no longer has ground truth")
    truth = ground_truth(read.labels, study.truth, study.pieces)
    tiles: list[tuple[str, NDArray[np.uint8]]] = [
        ("color", cloud.color),
        ("depth", pictures.depth_colors(read.depth_mm)),
        ("ground truth", pictures.label_colors(truth)),
    ]
    for variant in variants:
        labels = cv2.imread(str(store.folder / label_path(frame["key"], variant)), cv2.IMREAD_UNCHANGED)
        if labels is None:
            continue
        score = frame["results"][variant.key]
        caption = f"{variant.name}: GTRC {score['gtrc']:.3f}, VoI {score['voi']:.2f}"
        counted = np.where(cloud.valid, labels, 0)
        tiles.append((caption, pictures.label_colors(counted, np.where(cloud.valid, truth, 0))))
    write_atomically(folder / f"{frame['key']}-{frame['name']}.png", pictures.strip_png(tiles))
    return {
        "name": frame["name"],
        "category": frame["category"],
        "scores": frame["results"][best.key],
        "tiles": [
            (caption, _base64(pictures.jpeg(pictures.tile(image, _TILE_PX)))) for caption, image in tiles
        ],
    }


def _tree_pictures(
    study: Study, store: StudyStore, results: StudyResults, variant: Variant, folder: Path
) -> list[tuple[str, str]]:
    """Draw trees and fitting errors of the worst and best frames of a variant."""
    order = results.worst_frames(variant)
    drawn = []
    for key, frame in {each["key"]: each for each in (*order[:_TREES], *order[-_TREES:])}.items():
        path = store.folder / tree_path(key, variant)
        if not path.exists():
            continue
        try:
            image = plots.tree_plot(read_json(path)["segments"])
        except (KeyError, TypeError, ValueError) as err:
            raise ValueError(f"{path}: cannot be drawn ({err!r}); remove it to leave it out") from err
        errors = pictures.strip_png(_error_tiles(study, frame, variant), 420)
        name = frame["name"]
        drawn.append((f"{name}: tree of {variant.name}", _saved(folder / f"{key}-{name}-tree.png", image)))
        caption = f"{name}: fitting error, blue 0 to red {_ERROR_M} m"
        drawn.append((caption, _saved(folder / f"{key}-{name}-errors.png", errors)))
    return drawn


def _error_tiles(
    study: Study, frame: Mapping[str, Any], variant: Variant
) -> list[tuple[str, NDArray[np.uint8]]]:
    """Draw the residuals of the whole cloud, its parts, and the leaves (figure 2)."""
    cloud = register(read_frame(FrameRef(frame["uri"], frame["index"], frame["key"]), study.options))
    _, tree = Answers(cloud, frame["name"], frame["index"], study.seed).of(variant)
    tiles = [("color", cloud.color)]
    if tree is None:
        return tiles
    first = _fitted(tree, [tree.root])
    levels = (
        ("one surface" if len(first) == 1 else "first surfaces", first),
        (
            "after the first split",
            _fitted(tree, [segment for segment in tree.segments if segment.depth == 1]),
        ),
        ("leaves", _fitted(tree, tree.leaves())),
    )
    for caption, segments in levels:
        residual_m = np.full(cloud.valid.size, np.nan)
        for segment in segments:
            residual_m[segment.fit.pixels] = segment.fit.residuals_m
        step = grid_step(cloud.valid, variant.config.decimation)
        image = _spread(residual_m.reshape(cloud.valid.shape), step)
        tiles.append((caption, pictures.error_colors(image, _ERROR_M)))
    return tiles


def _fitted(tree: SegmentationTree, segments: Sequence[Segment]) -> list[Segment]:
    """Replace segments without a surface by their nearest parts that have one."""
    by_name = {segment.name: segment for segment in tree.segments}
    found, open_ = [], list(segments)
    while open_:
        each = open_.pop()
        if each.fit.surface is not None:
            found.append(each)
        else:
            open_ += [by_name[name] for name in each.children]
    return found


def _spread(image: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """Fill pixels between those of a decimated grid with the value to their upper left."""
    height, width = image.shape
    return image[::step, ::step].repeat(step, axis=0).repeat(step, axis=1)[:height, :width]


def _saved(path: Path, png: bytes) -> str:
    """Write a picture, and return it for the report."""
    write_atomically(path, png)
    return _base64(png)


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
