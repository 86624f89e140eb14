"""What is compared: a method with its settings, and the grids that name many of them at once."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from nurbseg.drivers.settings import nested, setting_paths, updated, value_kind
from nurbseg.segmentation.config import Metric, SegmentationConfig

#: Methods decided by the tree of surface fits; the metric and threshold grids apply to them alone.
TREE_METHODS = ("nurbseg", "stag15", "pz14")

#: Settings that the flat clustering shares with the trees; it chooses lambda itself.
_FLAT_SETTINGS = ("samples", "affinity_scale")

#: Settings that a method's name stands for.
_FIXED = {
    "stag15": ("method",),
    "nurbseg": ("method",),
    "pz14": ("method", "metric", "stag15.control_points"),
}

#: Begins the name of a method that stands for label images of another program.
LABELS_PREFIX = "labels:"


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of a table: a method, its settings and the name under which it is reported.

    Parameters
    ----------
    name : str
        Unique in a study, e.g. ``stag15 mse T=0.9``.
    method : str
        Name of the method, or ``labels:DIR`` for label images of another program.
    config : SegmentationConfig
        Settings of the methods of this project; of them ``dmzc12`` uses the samples and the affinity
        scale, and the other rivals none.
    lambda_auto : bool
        Whether lambda is chosen for each frame by the unsupervised quality.
    content : str
        What results depend on besides: the state of the label images of another program.
    """

    name: str
    method: str
    config: SegmentationConfig
    lambda_auto: bool = False
    content: str = ""

    @property
    def key(self) -> str:
        """Name of this variant's results on disk: equal for equal work and for nothing else."""
        config = asdict(self.config)
        if self.method not in TREE_METHODS:
            used = _FLAT_SETTINGS if self.method == "dmzc12" else ()
            config = {name: config[name] for name in used}
        parts = [self.method, config, self.lambda_auto, *([self.content] if self.content else [])]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def setting_value(name: str, text: str) -> Any:
    """Turn the text of a setting, by its name or symbol (``lambda``), into its value.

    Raises ValueError if there is no such setting, or the text is no value of it.
    """
    path = path_named(name)
    try:
        value = value_kind(SegmentationConfig, path).from_text(text)
    except ValueError as err:
        raise ValueError(f"{name}: {err}") from None
    updated(SegmentationConfig(), **nested({path: value}))
    return value


def path_named(name: str) -> str:
    """Return the path (``stag15.control_points``) of the setting that a name or symbol stands for."""
    wanted = name.replace("-", "_")
    for path, each in setting_paths(SegmentationConfig):
        if wanted in (path, each.name, each.metadata["symbol"], each.metadata["formerly"]):
            return path
    known = ", ".join(each.name for _, each in setting_paths(SegmentationConfig))
    raise ValueError(f"{name}: no such setting; available: {known}")


def grid_of(texts: Iterable[str]) -> dict[str, list[Any]]:
    """Read ``NAME=VALUE,VALUE,...`` texts into the values of each setting; ``lambda=auto`` is allowed.

    Raises ValueError if a text has another form, a value is not one of its setting's, or the setting is the
    method, which is not part of a grid.
    """
    grid: dict[str, list[Any]] = {}
    for text in texts:
        name, equals, values = text.partition("=")
        if not equals or not values:
            raise ValueError(f"{text}: expected NAME=VALUE,VALUE,...")
        path = path_named(name)
        if path == "method":
            raise ValueError(f"{text}: use --methods to choose methods")
        grid[path] = [
            "auto" if path == "geometry_weight" and value == "auto" else setting_value(name, value)
            for value in values.split(",")
        ]
    return grid


def variants_of(
    methods: Sequence[str],
    *,
    metrics: Sequence[str] = (),
    thresholds: Sequence[float] = (),
    grid: Mapping[str, Sequence[Any]] | None = None,
    base: SegmentationConfig | None = None,
) -> tuple[Variant, ...]:
    """Spell out a study's variants: every method with every combination of the settings that it uses.

    Metrics and thresholds, the configured ones where there are none, apply to the tree methods but ``pz14``,
    whose metric is MSE by definition; the grid (see `grid_of`) to the methods of this project. Raises
    ValueError if a metric is unknown or a combination is out of bounds.
    """
    base = base or SegmentationConfig()
    for metric in metrics:
        if metric not in get_args(Metric):
            raise ValueError(f"metric: expected one of {', '.join(get_args(Metric))}, got {metric!r}")
    axes: dict[str, Sequence[Any]] = dict(grid or {})
    variants: dict[str, Variant] = {}
    for method in methods:
        if method.startswith(LABELS_PREFIX):
            state = _state_of_images(Path(method.removeprefix(LABELS_PREFIX)))
            variants[method] = Variant(name=method, method=method, config=base, content=state)
            continue
        if method not in TREE_METHODS:
            own = {name: axes[name] for name in _FLAT_SETTINGS if method == "dmzc12" and name in axes}
        else:
            read = ("", "extended" if method == "nurbseg" else "stag15")
            own = {
                path: values
                for path, values in axes.items()
                if path not in _FIXED[method] and path.rpartition(".")[0] in read
            }
        if method in ("stag15", "nurbseg") and (metrics or thresholds):
            own = {
                "metric": list(metrics or [base.metric]),
                "ratio_max": list(thresholds or [base.ratio_max]),
                **own,
            }
        for values in itertools.product(*own.values()):
            variant = _variant(method, dict(zip(own, values, strict=True)), base)
            variants[variant.name] = variant
    return tuple(variants.values())


def _variant(method: str, chosen: Mapping[str, Any], base: SegmentationConfig) -> Variant:
    settings = dict(chosen)
    lambda_auto = settings.get("geometry_weight") == "auto"
    if lambda_auto:
        del settings["geometry_weight"]
    words = [method]
    for path, value in chosen.items():
        words.append(str(value) if path == "metric" else f"{_symbol(path)}={value}")
    config = updated(base, method="nurbseg" if method == "nurbseg" else "stag15", **nested(settings))
    if method == "pz14":
        config = updated(config, metric="mse", stag15={"control_points": "fixed"})
    return Variant(name=" ".join(words), method=method, config=config, lambda_auto=lambda_auto)


def _state_of_images(folder: Path) -> str:
    """Tell one state of a folder's images from another, so that replaced ones are scored again."""
    found = [(path.name, path.stat()) for path in sorted(folder.glob("*.png"))]
    return json.dumps([(name, status.st_size, status.st_mtime_ns) for name, status in found])


def _symbol(path: str) -> str:
    if path == "ratio_max":
        return "T"
    each = dict(setting_paths(SegmentationConfig))[path]
    return each.metadata["symbol"] or each.name
