"""Searches for the settings that score best on labeled frames, and estimates the gain."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from operator import attrgetter
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.workers import in_order, open_workers
from nurbseg.common.errors import FrameFormatError
from nurbseg.common.settings import updated
from nurbseg.drivers.options import SourceOptions
from nurbseg.evaluation.results import Estimate, bootstrap_mean
from nurbseg.evaluation.scoring.frame import score_frame
from nurbseg.evaluation.study import FrameRef, Study, first_unusable, frame_refs, read_frame
from nurbseg.evaluation.truth import Truth, ground_truth
from nurbseg.segmentation.config import Metric, SegmentationConfig, SplittingPoint
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap, register


@dataclass(frozen=True, slots=True, eq=False)
class Tuned:
    """The result of a search."""

    #: The settings with the best mean objective over all frames, and this mean, which is optimistic.
    config: SegmentationConfig
    objective: float
    #: Cross-validated gain over the initial settings; each fold has the best settings of the others.
    gain: Estimate


def tune(
    study: Study,
    start: SegmentationConfig,
    *,
    budget: int,
    folds: int = 5,
    jobs: int = 1,
    seed: int = 0,
    report: Callable[[int, float], None] = lambda trial, best: None,
) -> Tuned:
    """Search metric, T, lambda, T_p, affinity scale and splitting point with Optuna.

    Each of `budget` settings, `start` first, is scored on every frame; other settings stay as in `start`.
    `report` is called after each with its number and the best mean so far. Raises ValueError if there are
    fewer than two labeled frames, or `budget` or `folds` is below 2.
    """
    import optuna

    if budget < 2:
        raise ValueError(f"budget: expected at least 2 settings to try, got {budget}")
    if folds < 2:
        raise ValueError(f"folds: expected at least 2 parts, got {folds}")
    refs = frame_refs(study)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    search = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
    search.enqueue_trial(searched_settings(start))
    distributions = _distributions(start.method)
    tried: list[SegmentationConfig] = []
    scores: list[NDArray[np.float64]] = []
    labeled = partial(_labeled_cloud, options=study.options, truth=study.truth, pieces=study.pieces)
    with open_workers(jobs) as workers:
        for number in range(budget):
            trial = search.ask(distributions)
            config = updated(start, **trial.params)
            judge = partial(_frame_objective, labeled=labeled, config=config)
            # Forward and backward in turn: always forward, a smaller cache would hold none of the next.
            way = slice(None, None, (-1) ** number)
            values = np.array([future.result() for _, future in in_order(workers, judge, refs[way])])[way]
            if np.isfinite(values).sum() < 2:
                raise ValueError(
                    f"{', '.join(study.sources)}: expected at least 2 frames with ground truth"
                    f"{first_unusable(study)}"
                )
            search.tell(trial, float(np.nanmean(values)))
            tried.append(config)
            scores.append(values)
            report(number + 1, max(float(np.nanmean(score)) for score in scores))
    table = np.array(scores)[:, np.isfinite(scores[0])]
    best = int(table.mean(axis=1).argmax())
    return Tuned(tried[best], float(table[best].mean()), _cross_validated_gain(table, folds, seed))


def _cross_validated_gain(table: NDArray[np.float64], folds: int, seed: int) -> Estimate:
    frames = table.shape[1]
    fold = np.random.default_rng(seed).permutation(frames) % min(folds, frames)
    chosen = np.empty(frames)
    for part in range(min(folds, frames)):
        held_out = fold == part
        winner = int(table[:, ~held_out].mean(axis=1).argmax())
        chosen[held_out] = table[winner, held_out]
    return bootstrap_mean(chosen - table[0])


@lru_cache(maxsize=100)  # half a gigabyte at 640x480
def _labeled_cloud(
    ref: FrameRef, options: SourceOptions, truth: Truth, pieces: int
) -> tuple[PointMap, NDArray[np.uint16]] | None:
    """Register a frame, and read its ground truth; return None if it is damaged or has no ground truth."""
    with suppress(FrameFormatError):
        frame = read_frame(ref, options)
        cloud = register(frame)
        if frame.labels is not None and (cloud.valid & (frame.labels > 0)).any():
            return cloud, ground_truth(frame.labels, truth, pieces)
    return None


def _frame_objective(
    ref: FrameRef,
    labeled: Callable[[FrameRef], tuple[PointMap, NDArray[np.uint16]] | None],
    config: SegmentationConfig,
) -> float:
    """Return the ground-truth region covering minus a tenth of the VoI in bits; NaN without ground truth.

    The covering alone hardly depends on how small objects are divided; VoI / 10 has a similar scale.
    """
    found = labeled(ref)
    if found is None:
        return float("nan")
    cloud, truth = found
    scores = score_frame(segment(cloud, config).labels(), truth, cloud.valid)
    return scores.gtrc - 0.1 * scores.voi


#: T_p of each method: the setting and its bounds.
_SMALLEST = {
    "stag15": ("stag15.segment_pixels_min", 50, 4000),
    "nurbseg": ("extended.piece_pixels_min", 50, 2000),
}


def searched_settings(config: SegmentationConfig) -> dict[str, Any]:
    """Return the settings that are searched, by path."""
    return {path: attrgetter(path)(config) for path in _distributions(config.method)}


def _distributions(method: str) -> dict[str, Any]:
    """Return Optuna's distributions of the searched settings, by path."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    smallest, least, most = _SMALLEST[method]
    return {
        "metric": CategoricalDistribution(get_args(Metric)),
        "ratio_max": FloatDistribution(0.5, 1.0),
        "geometry_weight": FloatDistribution(0.1, 10.0, log=True),
        "affinity_scale": FloatDistribution(0.3, 3.0, log=True),
        "splitting_point": CategoricalDistribution(get_args(SplittingPoint)),
        smallest: IntDistribution(least, most, log=True),
    }
