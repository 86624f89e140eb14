"""Decisions of a segmentation in words."""

from collections.abc import Mapping, Sequence

from nurbseg.segmentation.config import METRIC_UNITS, Metric
from nurbseg.segmentation.objects.merge import Contact
from nurbseg.segmentation.vocabulary import display_name

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
#: What a term of the log odds says if it is for one object, and if it is against.
_TERMS: Mapping[str, tuple[str, str]] = {
    "crease": ("their edge is like one within an object", "their edge is like one between objects"),
    "gap": ("they touch", "there is a step between them"),
    "border": ("they share much of their borders", "they share little of their borders"),
    "size": ("neither is large", "one is large"),
    "flatness": ("together they are as flat as apart", "together they are less flat than apart"),
    "shape": ("together they are compact", "together they are not compact"),
    "height": ("their heights over the support go together", "their heights over the support differ"),
    "orientation": ("they face as parts of one object do", "they face as different objects do"),
    "kept": ("they were one object before", "they were different objects before"),
}


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
    """Return what the ratio (eq. 5) decided.

    Parameters
    ----------
    parts : int
        Number of the parts.
    metric, ratio, limit : str, float, float
        The metric, its ratio, and T.
    kept, fold : bool
        Whether the split was kept, and whether two leaves were compared with one surface for both.
    """
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
    fits = f"a surface folded there fits {_times(ratio)} better"
    return f"kept apart: {count(parts)} parts meet in a crease; {fits}"


def divided(kind: str, parts: int) -> str:
    """Return why a segment was divided where the ratio does not decide."""
    if kind == "gap":
        return f"not connected: {count(parts)} components, separated by gaps in depth"
    number = "one part" if parts == 2 else f"{count(parts - 1)} parts"
    verb = "stands" if parts == 2 else "stand"
    return f"split off: {number} {verb} in front of the surface by more than noise"


def merged(number: int, leaves: int, contacts: Sequence[Contact]) -> str:
    """Return why leaves are one object: what most says so of the pair that is most likely one."""
    if not contacts:
        reasons = ["one continues the other behind what hides it"]
    else:
        reasons = [_TERMS[name][0] for name, _ in _strongest(contacts[0]) if name in _TERMS]
    why = " and ".join(reasons[:2])
    return f"object {number}: {count(leaves)} surfaces{f', since {why}' if why else ''}"


def contact(each: Contact) -> str:
    """Return the evidence on a pair of leaves that meet, with its log odds."""
    pair = f"{display_name(each.first)} and {display_name(each.second)}"
    return f"{pair}: log odds {each.log_odds:+.2f}: {evidence(each)}"


def evidence(each: Contact) -> str:
    """Return the two strongest terms of a pair's log odds."""
    terms = sorted(each.evidence.items(), key=lambda item: -abs(item[1]))
    told = [f"{_TERMS[name][item < 0]} ({item:+.1f})" for name, item in terms if name in _TERMS]
    return ", ".join(told[:2])


def _strongest(each: Contact) -> list[tuple[str, float]]:
    return sorted(((n, v) for n, v in each.evidence.items() if v > 0), key=lambda item: -item[1])
