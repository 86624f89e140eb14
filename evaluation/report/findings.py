"""The tables of a study, as in the paper, and its findings as sentences."""

import math
from collections.abc import Mapping, Sequence

from nurbseg.evaluation.results import Estimate, StudyResults, bootstrap_mean
from nurbseg.evaluation.scoring.frame import SCORES
from nurbseg.evaluation.variants import Variant


def summary_rows(results: StudyResults, seconds: Mapping[str, float]) -> list[list[str]]:
    """Return a table of each method with its first setting and that with the best GTRC."""
    firsts = {variant.method: variant.name for variant in reversed(results.variants)}
    shown = {*firsts.values(), *(leader.name for leader in results.leaders())}
    scores = ("ri", "gtrc", "voi", "obj", "found")
    names = [SCORES[score][0] if score in SCORES else score for score in scores]
    rows = [["variant", *names, "95 % interval of GTRC", "segments", "ms/frame"]]
    for variant in results.variants:
        if variant.name in shown:
            means = (digits(results.mean(variant, score)) for score in scores)
            sure, segments = interval(results.estimate(variant, "gtrc")), results.mean(variant, "segments")
            rows.append([variant.name, *means, sure, f"{segments:.1f}", _milliseconds(variant, seconds)])
    return rows


#: Columns of the table of all scores: the score, its heading, its digits, and whether greater is better.
_COLUMNS: tuple[tuple[str, str, int, bool | None], ...] = (
    *((score, heading, 3, greater) for score, (heading, greater) in SCORES.items()),
    ("overlap_f", "overlap F", 3, True),
    ("boundary_f", "boundary F", 3, True),
    ("found", "found", 3, True),
    ("over", "over", 3, False),
    ("under", "under", 3, False),
    ("precision", "precision", 3, True),
    ("recall", "recall", 3, True),
    ("segments", "segments", 1, None),
    ("regions", "of", 1, None),
)


def joint_rows(
    results: StudyResults, variants: Sequence[Variant], seconds: Mapping[str, float]
) -> list[list[str]]:
    """Return a table of all scores of these variants; the best of a column in ``*``."""
    rows = [[variant.name] for variant in variants]
    for score, _, places, greater in _COLUMNS:
        means = [round(results.mean(variant, score), places) for variant in variants]
        known = [mean for mean in means if math.isfinite(mean)]
        best = None if greater is None or not known else (max if greater else min)(known)
        for row, mean in zip(rows, means, strict=True):
            text = "-" if math.isnan(mean) else f"{mean:.{places}f}"
            row.append(f"*{text}*" if mean == best else text)
    for row, variant in zip(rows, variants, strict=True):
        row += [interval(results.estimate(variant, "gtrc")), _milliseconds(variant, seconds)]
    return [["variant", *(heading for _, heading, *_ in _COLUMNS), "95 % of GTRC", "ms"], *rows]


def score_rows(results: StudyResults, score: str) -> list[list[str]]:
    """Return the table of a score: categories, mean and interval; the best of a column in ``*``."""
    categories = results.categories()
    columns: list[str | None] = [*categories, None] if len(categories) > 1 else [None]
    rows = [["variant", *("mean" if column is None else column for column in columns), "95 % interval"]]
    best = {column: results.best(score, column) for column in columns}
    for variant in results.variants:
        row = [variant.name]
        for column in columns:
            text = digits(results.mean(variant, score, column))
            row.append(f"*{text}*" if variant.name in best[column] else text)
        row.append(interval(results.estimate(variant, score)))
        rows.append(row)
    return rows


def as_text(rows: Sequence[Sequence[str]]) -> str:
    """Format a table for a terminal."""
    first, *others = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for name, *cells in rows:
        figures = (cell.rjust(width) for cell, width in zip(cells, others, strict=True))
        lines.append("  ".join([name.ljust(first), *figures]).rstrip())
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def as_markdown(rows: Sequence[Sequence[str]]) -> str:
    """Format a table as Markdown; cells in ``*`` become bold."""
    lines = ["| " + " | ".join(cell.replace("*", "**") for cell in row) + " |" for row in rows]
    lines.insert(1, "| --- |" + " ---: |" * (len(rows[0]) - 1))
    return "\n".join(lines)


def all_tables(results: StudyResults, seconds: Mapping[str, float]) -> list[tuple[str, list[list[str]]]]:
    """Return all tables with their captions."""
    tables = []
    for score, (heading, greater) in SCORES.items():
        direction = "greater" if greater else "smaller"
        tables.append((f"{heading}: mean over frames, {direction} is better", score_rows(results, score)))
    caption = "All scores, boundaries within 2 px; objects matched one to one, without background"
    return [*tables, (caption, joint_rows(results, results.variants, seconds))]


def _milliseconds(variant: Variant, seconds: Mapping[str, float]) -> str:
    """Format the time of a variant per frame, or "" if it was not measured."""
    return f"{1000 * seconds[variant.name]:.0f}" if variant.name in seconds else ""


def digits(value: float) -> str:
    """Format a score with three digits, or "-"."""
    return "-" if math.isnan(value) else f"{value:.3f}"


def interval(estimate: Estimate) -> str:
    """Format an interval."""
    return f"{digits(estimate.low)} to {digits(estimate.high)}"


def conclusions(results: StudyResults) -> list[str]:
    """Return the verdict and the findings of a study."""
    means = {
        score: {variant.name: results.mean(variant, score) for variant in results.variants}
        for score in SCORES
    }
    return [verdict(results), *findings(means)]


def verdict(results: StudyResults) -> str:
    """Describe which method is best with its best setting, and the confidence interval.

    Of one method alone, two settings are compared.
    """
    leaders = results.leaders()
    compared = leaders if len(leaders) > 1 else results.variants
    ranked = sorted(compared, key=lambda each: -results.mean(each, "gtrc"))
    first = f"{ranked[0].name} (GTRC {digits(results.mean(ranked[0], 'gtrc'))})"
    if len(ranked) == 1:
        return f"Verdict: {first} is the best setting that was tried, on {len(results.frames)} frames."
    ours, theirs = (results.values(each, "gtrc") for each in ranked[:2])
    gain = bootstrap_mean(ours - theirs)
    sure = "is ahead of" if gain.low > 0 else "cannot be told apart from"
    return (
        f"Verdict: {first} {sure} {ranked[1].name} ({digits(results.mean(ranked[1], 'gtrc'))}): better on "
        f"{(ours > theirs).sum()} of {gain.frames} frames, by {digits(gain.mean)} in the mean "
        f"(95 %: {interval(gain)})."
    )


def findings(means: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Describe the ranking of methods by each score, and the range of each method over its settings.

    `means` are those of each score over all frames by the names of variants, which begin with the method.
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
    known = [name for name in names if math.isfinite(means[name])]
    return sorted(known, key=lambda name: round(means[name], 3) * (-1 if greater else 1))


def _setting(name: str) -> str:
    """Return a variant's name without its method."""
    return name.partition(" ")[2]
