"""Decisions of a segmentation in words."""

from collections.abc import Mapping

from nurbseg.library.contact_words import reasons_for
from nurbseg.segmentation.config import METRIC_UNITS, Metric
from nurbseg.segmentation.objects.merge import Contact

_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
#: What surfaces do better if the metric is smaller: a verb, and how much more.
_BETTER: Mapping[Metric, tuple[str, str]] = {
    "mse": ("fit", "better"),
    "mae": ("fit", "better"),
    "ve": ("fit", "more evenly"),
    "nle": ("leave", "fewer points far off"),
    "vmxc": ("bend", "more evenly"),
    "vmec": ("bend", "more evenly"),
    "vgc": ("bend", "more evenly"),
    "mmxc": ("bend", "less"),
    "nlc": ("bend strongly at", "fewer points"),
}
#: Units in which residuals are told, and their number in SI units.
_RESIDUAL_UNITS = {"m": ("mm", 1e3), "m²": ("mm²", 1e6)}


def count(number: int) -> str:
    """Return a number as a word, up to ten."""
    return _NUMBERS[number] if number < len(_NUMBERS) else str(number)


def value_text(metric: Metric, value: float) -> str:
    """Return a metric's value with its unit; residuals in millimeters."""
    unit, scale = _RESIDUAL_UNITS.get(METRIC_UNITS[metric], (METRIC_UNITS[metric], 1.0))
    told = value * scale
    return f"{told:,.0f} {unit}" if told >= 1000.0 or unit == "points" else f"{told:.3g} {unit}"


def compared(ratio: float, limit: float) -> str:
    """Return a ratio with as many digits as tell it from the limit."""
    for digits in range(2, 7):
        text = f"{ratio:.{digits}f}"
        if (float(text) < limit) == (ratio < limit) and (float(text) != limit or ratio == limit):
            break
    return text


def judged(parts: int, metric: Metric, ratio: float, limit: float, *, kept: bool, fold: bool) -> str:
    """Return the decision of the ratio (eq. 5) against T: on a split, or on two leaves and one surface."""
    told = compared(ratio, limit)
    why = f"{told} is not below {limit:g}" if ratio < float("inf") else "one surface explains everything"
    if fold and not kept:
        return f"one surface after all: two parts meet smoothly, and {why}"
    if not kept:
        return f"not kept: {why}"
    if not ratio < limit:
        return f"kept, although {why}: the first split always is"
    if ratio >= 1.0:
        return f"kept apart: {told} is below {limit:g}"
    if ratio == 0.0:
        return f"kept apart: {count(parts)} surfaces explain everything"
    verb, better = _BETTER[metric]
    return f"kept apart: {count(parts)} surfaces {verb} {_times(ratio)} {better}"


def _times(ratio: float) -> str:
    if ratio > 0.8:
        percent = 100.0 * (1.0 - ratio)
        return f"{percent:.0f} %" if percent >= 1.0 else "slightly"
    return f"{1.0 / ratio:.1f} times" if ratio > 0.1 else f"{1.0 / ratio:.0f} times"


def creased(parts: int, ratio: float) -> str:
    """Return why a segment was divided at creases, by the ratio of the folded surface."""
    told = f"{count(parts)} parts meet in a crease"
    return f"kept apart: {told}; a surface folded there fits {_times(ratio)} better"


def divided(kind: str, parts: int) -> str:
    """Return why a segment was divided where the ratio does not decide."""
    if kind == "gap":
        return f"not connected: {count(parts)} components, separated by gaps in depth"
    subject = "one part stands" if parts == 2 else f"{count(parts - 1)} parts stand"
    return f"split off: {subject} in front of the surface by more than noise"


def merged(label: int | None, leaves: int, best: Contact) -> str:
    """Return why leaves are one object: the strongest evidence on the pair that is most likely one."""
    why = " and ".join(reasons_for(best))
    subject = "an object" if label is None else f"object {label}"
    return f"{subject}: {count(leaves)} surfaces{f', since {why}' if why else ''}"
