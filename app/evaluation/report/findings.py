"""Findings of a study as sentences."""

from collections.abc import Mapping

import numpy as np

from nurbseg.app.evaluation.report.tables import digits, interval
from nurbseg.app.evaluation.results import StudyResults, bootstrap_mean
from nurbseg.app.evaluation.scoring import SCORES


def means_of(results: StudyResults) -> dict[str, dict[str, float]]:
    """Return each score's means over all frames by the names of variants."""
    return {score: {each.name: results.mean(each, score) for each in results.variants} for score in SCORES}


def verdict(results: StudyResults) -> str:
    """Describe which method is best with its best setting, and the confidence interval."""
    ranked = sorted(results.leaders(), key=lambda each: -results.mean(each, "gtrc"))
    first = f"{ranked[0].name} (GTRC {digits(results.mean(ranked[0], 'gtrc'))})"
    if len(ranked) == 1:
        return f"Verdict: {first} is the best setting that was tried, on {len(results.frames)} frames."
    ours, theirs = (results.values(each, "gtrc") for each in ranked[:2])
    gain = bootstrap_mean(ours - theirs)
    sure = "is ahead of" if gain.low > 0 else "cannot be told apart from"
    return (
        f"Verdict: {first} {sure} {ranked[1].name} ({digits(results.mean(ranked[1], 'gtrc'))}): better on "
        f"{np.count_nonzero(ours > theirs)} of {gain.frames} frames, by {digits(gain.mean)} in the mean "
        f"(95 %: {interval(gain)})."
    )


def findings(means: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Describe the ranking of methods by each score, and the range of each method over its settings.

    `means` comes from `means_of`; a variant's name begins with its method.
    """
    methods: dict[str, list[str]] = {}
    for name in means["ri"]:
        methods.setdefault(name.split(" ", maxsplit=1)[0], []).append(name)
    sentences = []
    for score, (heading, greater) in SCORES.items():
        ordered = [_ordered(means[score], names, greater) for names in methods.values()]
        ranked = _ordered(means[score], [names[0] for names in ordered if names], greater)
        if ranked:
            places = ", ".join(f"{name} {digits(means[score][name])}" for name in ranked)
            sentences.append(f"{heading}, the best setting of each method first: {places}.")
    for method, names in methods.items():
        ranges = []
        for score, (heading, greater) in SCORES.items():
            ranked = _ordered(means[score], names, greater)
            if len(ranked) > 1:
                best_name, worst_name = ranked[0], ranked[-1]
                ranges.append(
                    f"{heading} from {digits(means[score][best_name])} ({_setting(best_name)}) "
                    f"to {digits(means[score][worst_name])} ({_setting(worst_name)})"
                )
        if ranges:
            sentences.append(f"{method}, from its best setting to its worst: {', '.join(ranges)}.")
    return sentences


def _ordered(means: Mapping[str, float], names: list[str], greater: bool) -> list[str]:
    """Sort variants that have a mean, rounded to three digits, the best first."""
    known = [name for name in names if np.isfinite(means[name])]
    return sorted(known, key=lambda name: round(means[name], 3) * (-1 if greater else 1))


def _setting(name: str) -> str:
    """Return a variant's name without its method."""
    return name.partition(" ")[2]
