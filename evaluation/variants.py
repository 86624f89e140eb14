"""The methods and settings that are compared, and grids of settings."""

import hashlib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from nurbseg.common.settings import assigned, setting_named, setting_paths, updated
from nurbseg.segmentation.config import SegmentationConfig

#: Methods with a tree of surface fits, to which grids of metrics and thresholds apply.
TREE_METHODS = ("nurbseg", "stag15", "pz14")

#: Settings of the flat clustering, which chooses lambda itself.
_FLAT_SETTINGS = ("samples", "affinity_scale")

#: Settings of `stag15` that the name of ``pz14`` implies.
_FIXED = ("metric", "stag15.control_points")

#: Prefix of methods that read label images of another program.
LABELS_PREFIX = "labels:"

#: Prefix of functions of other modules.
FUNCTION_PREFIX = "from:"


@dataclass(frozen=True, slots=True)
class Variant:
    """A method with settings: a row of the tables."""

    #: Unique in a study: ``stag15 mse T=0.9``.
    name: str
    #: Name of the method, ``labels:DIR`` for label images of another program, or ``from:MODULE:FUNCTION``.
    method: str
    #: Of these settings, ``dmzc12`` uses the samples and the affinity scale, and other baselines none.
    config: SegmentationConfig
    #: Whether lambda is chosen for each frame by the unsupervised quality.
    lambda_auto: bool = False
    #: State of the label images of another program, or of a function's module.
    content: str = ""

    @property
    def key(self) -> str:
        """Name of the variant's results on disk, which is equal for equal work only."""
        config = asdict(self.config)
        if self.method not in TREE_METHODS:
            used = _FLAT_SETTINGS if self.method == "dmzc12" else ()
            config = {name: config[name] for name in used}
        parts = [self.method, config, self.lambda_auto, *([self.content] if self.content else [])]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def grid_of(texts: Iterable[str]) -> dict[str, list[Any]]:
    """Parse ``NAME=VALUE,VALUE,...`` into the values of each setting; ``lambda=auto`` is allowed.

    Raises ValueError if a text has another form, a value is invalid, or the setting is the method.
    """
    grid: dict[str, list[Any]] = {}
    for text in texts:
        name, equals, values = text.partition("=")
        if not equals or not values:
            raise ValueError(f"{text}: expected NAME=VALUE,VALUE,...")
        path, _ = setting_named(SegmentationConfig, name)
        if path == "method":
            raise ValueError(f"{text}: use --methods to choose methods")
        grid[path] = [
            "auto"
            if path == "geometry_weight" and value == "auto"
            else assigned(SegmentationConfig, f"{path}={value}")[1]
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
    """Return every method with every combination of the settings that it uses.

    Metrics and thresholds (by default those of `base`) apply to the tree methods except ``pz14``, whose
    metric is MSE; `grid` comes from `grid_of`. Raises ValueError if a metric or value is invalid.
    """
    base = base or SegmentationConfig()
    for metric in metrics:
        assigned(SegmentationConfig, f"metric={metric}")
    variants: dict[str, Variant] = {}
    for method in methods:
        if method.startswith(LABELS_PREFIX):
            state = _state_of_images(Path(method.removeprefix(LABELS_PREFIX)))
            variants[method] = Variant(name=method, method=method, config=base, content=state)
            continue
        if method.startswith(FUNCTION_PREFIX):
            name = method.removeprefix(FUNCTION_PREFIX)
            content = hashlib.sha256(source_of(name.partition(":")[0])).hexdigest()
            variants[name] = Variant(name=name, method=method, config=base, content=content)
            continue
        axes: dict[str, Sequence[Any]] = {}
        if method in ("stag15", "nurbseg") and (metrics or thresholds):
            axes = {"metric": metrics or [base.metric], "ratio_max": thresholds or [base.ratio_max]}
        axes |= {path: values for path, values in (grid or {}).items() if _reads(method, path)}
        for values in itertools.product(*axes.values()):
            variant = _variant(method, dict(zip(axes, values, strict=True)), base)
            variants[variant.name] = variant
    return tuple(variants.values())


def _reads(method: str, path: str) -> bool:
    """Whether a setting changes the labels of a method."""
    if method not in TREE_METHODS:
        return method == "dmzc12" and path in _FLAT_SETTINGS
    if method == "pz14" and path in _FIXED:
        return False
    return path.rpartition(".")[0] in ("", "extended" if method == "nurbseg" else "stag15")


def _variant(method: str, chosen: Mapping[str, Any], base: SegmentationConfig) -> Variant:
    words = [str(value) if path == "metric" else f"{_symbol(path)}={value}" for path, value in chosen.items()]
    settings = dict(chosen)
    if lambda_auto := settings.get("geometry_weight") == "auto":
        del settings["geometry_weight"]
    config = updated(base, method="nurbseg" if method == "nurbseg" else "stag15", **settings)
    if method == "pz14":
        config = updated(config, metric="mse", stag15={"control_points": "fixed"})
    return Variant(name=" ".join([method, *words]), method=method, config=config, lambda_auto=lambda_auto)


def source_of(module: str) -> bytes:
    """Return the source of a module, empty if it has none; raises ValueError if there is no such module."""
    try:
        found = find_spec(module)
    except (ImportError, ValueError):
        found = None
    if found is None:
        raise ValueError(
            f"--method-from {module}: there is no such module; install it, or name its folder in PYTHONPATH"
        )
    path = Path(found.origin or "")
    return path.read_bytes() if path.is_file() else b""


def _state_of_images(folder: Path) -> str:
    """Describe the state of a folder's images, so that replaced ones are scored again."""
    found = [(path.name, path.stat()) for path in sorted(folder.glob("*.png"))]
    return json.dumps([(name, status.st_size, status.st_mtime_ns) for name, status in found])


def _symbol(path: str) -> str:
    if path == "ratio_max":
        return "T"
    each = dict(setting_paths(SegmentationConfig))[path]
    return each.metadata["symbol"] or each.name
