"""The results of a study: stored by frame, so that a killed run can be resumed, and their means."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from nurbseg.app.export.run_settings import differences
from nurbseg.common.errors import quoted
from nurbseg.common.files import create_folder, read_json, write_atomically, write_json
from nurbseg.evaluation.scoring.frame import SCORES, FrameScores
from nurbseg.evaluation.scoring.objects import ObjectScores
from nurbseg.evaluation.variants import Variant

_FORMAT = 1
#: The file with the name, method and mean GTRC of each variant, by its key.
VARIANTS_FILE = "variants.json"
#: Fields of a frame that was not skipped.
_FIELDS = {"uri": str, "index": int, "name": str, "category": str, "truth": str, "results": dict}
#: Its scores, each a number or null, and those that are always numbers.
_SCORES, _ALWAYS = (*FrameScores._fields, *ObjectScores._fields), ("ri", "gtrc", "voi")
_NUMBER, _NUMBER_OR_NULL = int | float, int | float | None
_KINDS: dict[Any, str] = {str: "a text", int: "a whole number", dict: "an object"}
_KINDS |= {_NUMBER: "a number", _NUMBER_OR_NULL: "a number or null"}


class StudyStore:
    """A folder with a study's description and a file for each finished frame.

    Raises ValueError if the folder cannot be created, or contains another study or files of another kind.
    """

    def __init__(self, folder: Path, description: Mapping[str, Any]) -> None:
        self.folder = folder
        create_folder(folder)
        create_folder(folder / "frames")
        wanted = json.loads(json.dumps({"format": _FORMAT, **description}))
        path = folder / "study.json"
        if path.exists():
            found = read_json(path)
            if found != wanted:
                raise ValueError(
                    f"{path}: contains another study: {'; '.join(differences(found, wanted))}: "
                    "give another folder with --out, or remove this one"
                )
        else:
            write_json(path, wanted)

    def frame(self, key: str) -> dict[str, Any]:
        """Return the results of a frame; empty if it is not finished."""
        path = self.folder / "frames" / f"{key}.json"
        try:
            # The key in the file may have been changed.
            frame = {**read_json(path), "key": key}
            for field, value, kind in () if frame.get("skipped") else _fields(frame):
                if not isinstance(value, kind):
                    raise ValueError(f"{path}: {field}: expected {_KINDS[kind]}, got {quoted(value)}")
        except FileNotFoundError:
            return {}
        except ValueError as err:
            raise ValueError(f"{err}; remove it to process its frame again") from err
        return frame

    def keep(self, key: str, frame: Mapping[str, Any], images: Mapping[str, bytes]) -> None:
        """Write a frame's images and trees, by their path in the folder, and then its results."""
        for name, content in images.items():
            path = self.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content)
        write_json(self.folder / "frames" / f"{key}.json", frame)


def _fields(frame: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield the fields of a frame with their values and types, the outer ones first."""
    for field, kind in _FIELDS.items():
        yield field, frame.get(field), kind
    yield "computer", frame.get("computer", ""), str
    for variant, scores in frame["results"].items():
        yield f"results.{variant}", scores, dict
        for score, value in {**dict.fromkeys(_SCORES, "nothing"), **scores}.items():
            yield f"results.{variant}.{score}", value, _NUMBER if score in _ALWAYS else _NUMBER_OR_NULL


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean over frames and its bootstrap interval."""

    mean: float
    low: float
    high: float
    frames: int


def bootstrap_mean(values: NDArray[np.float64], *, draws: int = 2000) -> Estimate:
    """Compute a mean over frames and its 95 % percentile bootstrap interval.

    Parameters
    ----------
    values : (N,) float64
        One value per frame; NaN is left out.
    draws : int
        Number of resamples.

    Returns
    -------
    Estimate
        NaN if there is no value.

    References
    ----------
    .. [1] B. Efron, R. Tibshirani, "An introduction to the bootstrap", 1993, chapter 13.
    """
    values = values[np.isfinite(values)]
    if values.size == 0:
        return Estimate(float("nan"), float("nan"), float("nan"), 0)
    mean = float(values.mean())
    if values.size == 1:
        return Estimate(mean, mean, mean, 1)
    low, high = bootstrap(
        (values,),
        np.mean,
        n_resamples=draws,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(mean, float(low), float(high), values.size)


@dataclass(frozen=True, slots=True, eq=False)
class StudyResults:
    """The finished frames of a study in their order, and the skipped ones."""

    variants: tuple[Variant, ...]
    frames: tuple[dict[str, Any], ...]
    skipped: tuple[dict[str, Any], ...]

    def categories(self) -> tuple[str, ...]:
        """Return the categories in the order of frames."""
        return tuple(dict.fromkeys(frame["category"] for frame in self.frames))

    def computers(self) -> tuple[str, ...]:
        """Return the processors and kernels of the frames, in the order of frames."""
        return tuple(dict.fromkeys(frame.get("computer", "a computer not recorded") for frame in self.frames))

    def values(self, variant: Variant, score: str, category: str | None = None) -> NDArray[np.float64]:
        """Return a score of the frames of a category, or of all, (N,) float64; NaN if a frame has none."""
        key = variant.key
        return np.array(
            [
                frame["results"][key][score]
                for frame in self.frames
                if category is None or frame["category"] == category
            ],
            dtype=np.float64,
        )

    def estimate(self, variant: Variant, score: str, category: str | None = None) -> Estimate:
        """Return a score's mean over frames with its 95 % bootstrap interval."""
        return bootstrap_mean(self.values(variant, score, category))

    def mean(self, variant: Variant, score: str, category: str | None = None) -> float:
        """Return a score's mean over the frames that have one, or NaN."""
        values = self.values(variant, score, category)
        values = values[np.isfinite(values)]
        return float(values.mean()) if values.size else float("nan")

    def best(self, score: str, category: str | None = None) -> set[str]:
        """Return the names of the variants with the best mean, rounded to three digits."""
        means = {variant.name: round(self.mean(variant, score, category), 3) for variant in self.variants}
        known = [value for value in means.values() if np.isfinite(value)]
        if not known:
            return set()
        wanted = max(known) if SCORES[score][1] else min(known)
        return {name for name, value in means.items() if value == wanted}

    def leaders(self) -> list[Variant]:
        """Return the variant with the best mean covering of each method."""
        best: dict[str, Variant] = {}
        for variant in self.variants:
            known = best.setdefault(variant.method, variant)
            if self.mean(variant, "gtrc") > self.mean(known, "gtrc"):
                best[variant.method] = variant
        return [variant for variant in self.variants if best[variant.method] is variant]

    def worst_frames(self, variant: Variant) -> tuple[dict[str, Any], ...]:
        """Return the frames sorted by ground-truth region covering, the worst first."""
        return tuple(
            sorted(self.frames, key=lambda frame: (frame["results"][variant.key]["gtrc"], frame["key"]))
        )

    def rows(self) -> list[dict[str, Any]]:
        """Return a flat row for each frame and variant."""
        return [
            {
                "frame": frame["name"],
                "source": frame["uri"],
                "index": frame["index"],
                "category": frame["category"],
                "truth": frame["truth"],
                "variant": variant.name,
                "method": variant.method,
                **frame["results"][variant.key],
            }
            for frame in self.frames
            for variant in self.variants
        ]


def write_variants(results: StudyResults, folder: Path) -> None:
    """Add the variants to those that the folder's results are of."""
    path = folder / VARIANTS_FILE
    known = read_json(path) if path.exists() else {}
    found = {
        variant.key: {"name": variant.name, "method": variant.method, "gtrc": results.mean(variant, "gtrc")}
        for variant in results.variants
    }
    write_json(path, {**known, **found})


def write_rows(results: StudyResults, folder: Path) -> tuple[Path, Path]:
    """Write ``results.parquet`` and ``results.csv``; return their paths."""
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    table = pyarrow.Table.from_pylist(results.rows())
    parquet, csv = folder / "results.parquet", folder / "results.csv"
    for path, write in ((parquet, pyarrow.parquet.write_table), (csv, pyarrow.csv.write_csv)):
        content = BytesIO()
        write(table, content)
        write_atomically(path, content.getvalue())
    return parquet, csv
