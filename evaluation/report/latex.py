"""The table of a study for a paper, in LaTeX."""

from collections.abc import Mapping
from math import isfinite

from nurbseg.evaluation.results import StudyResults

#: Columns: the score, its heading, its digits, and whether greater is better.
_COLUMNS = (
    ("ri", r"RI $\uparrow$", 3, True),
    ("gtrc", r"GTRC $\uparrow$", 3, True),
    ("voi", r"VoI $\downarrow$", 3, False),
    ("obj", r"obj $\uparrow$", 3, True),
    ("found", r"found $\uparrow$", 3, True),
)
_SPECIAL = str.maketrans(
    {
        **{each: f"\\{each}" for each in "&%$#_{}"},
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
    }
)


def latex_table(results: StudyResults, seconds: Mapping[str, float], about: str) -> str:
    """Return a table with a row for each setting; the best of a column in bold.

    It needs the package booktabs. `seconds` is the time per frame by variant; `about` becomes a comment.
    """
    shown = results.variants
    table = [[results.mean(each, score) for score, *_ in _COLUMNS] for each in shown]
    columns = [*_COLUMNS]
    if any(each.name in seconds for each in shown):
        columns.append(("time", r"ms $\downarrow$", 0, False))
        table = [
            [*row, 1000 * seconds.get(each.name, float("nan"))]
            for row, each in zip(table, shown, strict=True)
        ]
    best = []
    for (_, _, digits, greater), values in zip(columns, zip(*table, strict=True), strict=True):
        known = [round(value, digits) for value in values if isfinite(value)]
        best.append((max if greater else min)(known, default=None))
    lines = [f"% {' '.join(about.split())}", r"% \usepackage{booktabs}"]
    lines += [rf"\begin{{tabular}}{{l{'r' * len(columns)}}}", r"\toprule"]
    lines += [" & ".join(["method", *(heading for _, heading, *_ in columns)]) + r" \\", r"\midrule"]
    for each, row in zip(shown, table, strict=True):
        cells = [each.name.translate(_SPECIAL)]
        for (_, _, digits, _), value, top in zip(columns, row, best, strict=True):
            text = f"{value:.{digits}f}" if isfinite(value) else "--"
            cells.append(rf"\textbf{{{text}}}" if round(value, digits) == top else text)
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])
