"""What became of the changes that the tests were to notice, as a page of tables."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cosmic_ray.work_item import MutationSpec

#: The packages that are sampled, each with a score of its own.
PACKAGES = ("segmentation", "drivers", "app", "common", "evaluation", "library")
_COUNTED = "changes | noticed | by a time limit | equivalent | survivors | score |"


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one place.

    Parameters
    ----------
    module : str
        File below `segmentation/`, or with the name of another package, without its ending.
    spec : MutationSpec
        The change.
    before, after : str
        The lines that it changes.
    """

    module: str
    spec: MutationSpec
    before: str
    after: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a mutant: ``killed``, ``timeout`` or ``survived``, and why it may survive."""

    mutant: Mutant
    state: str
    kind: str = ""
    reason: str = ""


def source_of(module: str) -> Path:
    """Return the file of a module, below the folder of all packages."""
    path = Path(f"{module}.py")
    return path if path.parts[0] in PACKAGES else "segmentation" / path


def package_of(module: str) -> str:
    """Return the package of a module."""
    return source_of(module).parts[0]


def is_within(module: str, only: str) -> bool:
    """Say whether a module is that file, or in that folder; all are in that of no name."""
    return f"{module}/".startswith(f"{only.rstrip('/')}/".lstrip("/")) or only == package_of(module)


def share(package: str, modules: Sequence[str]) -> float:
    """Return the part of a package's lines that are in some of its modules."""
    length = {path: len(path.read_bytes().splitlines()) for path in Path(package).rglob("*.py")}
    return sum(length[source_of(module)] for module in modules) / max(sum(length.values()), 1)


def explained(mutant: Mutant, state: str, known: Sequence[Mapping[str, str]]) -> Outcome:
    """Add the reason of a survivor, where one is known."""
    if state == "survived":
        for each in known:
            if (each["module"], each["before"], each["after"]) == (
                mutant.module,
                mutant.before,
                mutant.after,
            ):
                return Outcome(mutant, state, each["kind"], each["reason"])
    return Outcome(mutant, state)


def score(outcomes: Sequence[Outcome]) -> tuple[int, int]:
    """Return how many mutants died, and how many could."""
    died = sum(outcome.state != "survived" for outcome in outcomes)
    return died, len(outcomes) - sum(outcome.kind == "equivalent" for outcome in outcomes)


def _counts(outcomes: Sequence[Outcome]) -> str:
    died, could = score(outcomes)
    late = sum(outcome.state == "timeout" for outcome in outcomes)
    percent = f"{100 * died / could:.0f} %" if could else ""
    return f"{len(outcomes)} | {died} | {late} | {len(outcomes) - could} | {could - died} | {percent} |"


def report(
    outcomes: Sequence[Outcome], modules: Sequence[str], arguments: Sequence[str], took_s: float
) -> str:
    """Write the scores by module, and the survivors."""
    made_by = shlex.join(["python", "benchmarks/mutation.py", *arguments])
    lines = [
        "# Mutation tests",
        "",
        "Places of the code are changed one at a time (`<` to `<=`, `+` to `-`, a number by one, a",
        "condition to its opposite, a loop to none), and the tests of the file must fail. The sample is",
        "drawn by place, with one change of each; annotations and decorators are left out. Made in",
        f"{took_s / 60:.0f} minutes on {date.today()} by `{made_by}`.",
        "",
        "| package | files | of its lines | " + _COUNTED,
        "|---|---|---|" + 6 * "---|",
    ]
    for package in PACKAGES:
        within = [module for module in modules if package_of(module) == package]
        own = [outcome for outcome in outcomes if package_of(outcome.mutant.module) == package]
        lines.append(f"| `{package}` | {len(within)} | {100 * share(package, within):.0f} % | {_counts(own)}")
    lines += ["", "| file | " + _COUNTED, "|---|" + 6 * "---|"]
    for module in modules:
        lines.append(f"| `{module}.py` | {_counts([e for e in outcomes if e.mutant.module == module])}")
    lines.append(f"| **all** | {_counts(outcomes)}")
    lines += ["", "## Survivors", "", "Equivalent ones, which do not count, are in benchmarks/mutation.toml."]
    for outcome in outcomes:
        if outcome.state == "survived" and outcome.kind != "equivalent":
            why = f"{outcome.kind}: {outcome.reason}" if outcome.kind else "no reason is known"
            where = f"`{outcome.mutant.module}.py`, {outcome.mutant.spec.definition_name or 'constant'}"
            lines += ["", f"- {where}: {why}", "", "  ```diff", f"  -{outcome.mutant.before}"]
            lines += [f"  +{outcome.mutant.after}", "  ```"]
    return "\n".join(lines) + "\n"
