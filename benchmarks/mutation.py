"""Whether the tests notice: places of the code are changed one at a time, and the tests must fail each time.

The operators are those of Cosmic Ray. What is changed is a copy of the installed package, whose compiled
functions are compiled anew with it; tests and source are left alone.

Examples
--------
As docs/mutation.md was made::

    python benchmarks/mutation.py --out docs/mutation.md
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
import importlib.util
import os
import queue
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cosmic_ray.plugins
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.ast.ast_query import ASTQuery
from cosmic_ray.mutating import mutate_and_test, mutate_code
from cosmic_ray.work_item import MutationSpec, TestOutcome

#: Operators of one kind, by the names that Cosmic Ray gives them: one may stand for another where it was
#: meant for the same operands. What only raises a TypeError tells nothing of the tests.
_KINDS = (
    {"Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"},
    {"BitOr", "BitAnd", "BitXor", "RShift", "LShift"},
    {"Eq", "NotEq", "Lt", "LtE", "Gt", "GtE"},
    {"Is", "IsNot"},
)
_REPLACEMENTS = {"ReplaceBinaryOperator", "ReplaceComparisonOperator"}
_LEFT_OUT = {"NoOp", "RemoveDecorator"}
#: Memory of a test run, bytes; a changed size of an array may ask for any.
_MEMORY_MOST = 8 << 30


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one place.

    Parameters
    ----------
    module : str
        File below `segmentation/`, without its ending.
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


def declared(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return where annotations and decorators begin and end: they change no result."""
    found: list[ast.expr | None] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg | ast.AnnAssign):
            found.append(node.annotation)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            found += [*node.decorator_list, getattr(node, "returns", None)]
    return [
        ((each.lineno, each.col_offset), (each.end_lineno or 0, each.end_col_offset or 0))
        for each in found
        if each is not None
    ]


def is_meaningful(operator: str) -> bool:
    """Say whether an operator's change could be meant, by its name."""
    name, *between = operator.rpartition("/")[2].split("_")
    if name in _REPLACEMENTS:
        return any(kind.issuperset(between) for kind in _KINDS)
    return between[:1] == ["Delete"] if name == "ReplaceUnaryOperator" else name not in _LEFT_OUT


def changes(module: str, source: str, path: Path) -> Iterator[tuple[MutationSpec, Any]]:
    """Yield every change of a file that could be meant."""
    tree, apart = get_ast(source), declared(source)
    for name in filter(is_meaningful, sorted(cosmic_ray.plugins.operator_names())):
        make = cosmic_ray.plugins.get_operator(name)
        if make.arguments():
            continue
        operator = make()
        positions = (
            (node, begin, end) for node in ast_nodes(tree) for begin, end in operator.mutation_positions(node)
        )
        for occurrence, (node, begin, end) in enumerate(positions):
            if not any(first <= begin < last for first, last in apart):
                within = ASTQuery(node).get_definition_name()
                yield MutationSpec(path, name, occurrence, begin, end, definition_name=within), operator


def sampled(module: str, path: Path, most: int, seed: int) -> list[Mutant]:
    """Draw places of a file and one change of each, by a hash that does not depend on the other places."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    by_place: dict[tuple[tuple[int, int], tuple[int, int]], list[tuple[str, MutationSpec, Any]]] = {}
    seen: dict[str, int] = {}
    for spec, operator in changes(module, source, path):
        line = lines[spec.start_pos[0] - 1].strip()
        text = f"{seed} {module} {spec.definition_name} {line} {spec.operator_name}"
        seen[text] = seen.get(text, 0) + 1
        drawn = hashlib.sha256(f"{text} {seen[text]}".encode()).hexdigest()
        by_place.setdefault((spec.start_pos, spec.end_pos), []).append((drawn, spec, operator))
    one_each = sorted(min(place, key=lambda each: each[0]) for place in by_place.values())
    return [_described(module, source, spec, operator) for _, spec, operator in one_each[:most]]


def _described(module: str, source: str, spec: MutationSpec, operator: Any) -> Mutant:
    mutated = mutate_code(source, operator, spec.occurrence)
    lines = [each for each in difflib.ndiff(source.splitlines(), mutated.splitlines()) if each[0] in "-+"]
    before, after = (
        " ".join(" ".join(each[2:] for each in lines if each[0] == sign).split()) for sign in "-+"
    )
    return Mutant(module, spec, before, after)


class Copies:
    """Copies of the installed package, one for each process, in which the changes are made."""

    def __init__(self, folder: Path, count: int) -> None:
        self.all = [folder / f"copy{n}" for n in range(count)]
        self.free: queue.Queue[Path] = queue.Queue()
        for copy in self.all:
            for package in ("app", "drivers", "recordings", "segmentation"):
                spec = importlib.util.find_spec(f"nurbseg.{package}")
                if spec is None or not spec.submodule_search_locations:
                    raise SystemExit(f"nurbseg.{package} is not installed here: make setup-test")
                shutil.copytree(spec.submodule_search_locations[0], copy / "nurbseg" / package)
            self.free.put(copy)

    def run(self, mutant: Mutant, tests: Sequence[str], timeout_s: float) -> str:
        """Run tests against a change; return what became of it."""
        copy = self.free.get(timeout=24 * 3600)
        try:
            path = copy / "nurbseg" / "segmentation" / f"{mutant.module}.py"
            spec = mutant.spec
            there = MutationSpec(path, spec.operator_name, spec.occurrence, spec.start_pos, spec.end_pos)
            result = mutate_and_test([there], shlex.join(command(copy, tests)), timeout_s)
        finally:
            self.free.put(copy)
        if result.test_outcome is TestOutcome.SURVIVED:
            return "survived"
        if result.test_outcome is not TestOutcome.KILLED:
            raise SystemExit(f"{mutant.module}: {mutant.after}: the tests did not run: {result.output}")
        return "timeout" if result.output == "timeout" else "killed"


def command(copy: Path, tests: Sequence[str]) -> list[str]:
    """Return what runs tests against a copy; they end at the first failure."""
    pytest = str(Path(sys.executable).parent / "pytest")
    return ["env", f"PYTHONPATH={copy}", pytest, "-x", "-q", "-p", "no:cacheprovider", *tests]


def unchanged(copy: Path, tests: Sequence[str]) -> float:
    """Run tests against an unchanged copy; return the seconds that takes."""
    begin = time.monotonic()
    run = subprocess.run(command(copy, tests), capture_output=True, text=True, timeout=1800)
    if run.returncode:
        raise SystemExit(f"the tests fail without any change:\n{run.stdout}")
    return time.monotonic() - begin


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
    died = sum(each.state != "survived" for each in outcomes)
    return died, len(outcomes) - sum(each.kind == "equivalent" for each in outcomes)


def report(
    outcomes: Sequence[Outcome], modules: Sequence[str], arguments: Sequence[str], took_s: float
) -> str:
    """Write the scores by module, and the survivors."""
    lines = [
        "# Mutation tests",
        "",
        "Places of the code are changed one at a time (`<` to `<=`, `+` to `-`, a number by one, a condition to",
        "its opposite, a loop to none), and the tests of the file must fail. The sample is drawn by place, with",
        f"one change of each. Made by `{shlex.join(['python', 'benchmarks/mutation.py', *arguments])}`",
        f"in {took_s / 60:.0f} minutes.",
        "",
        "| file | changes | noticed | by a time limit | equivalent | survivors | score |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, own in [
        *(
            (f"`{module}.py`", [each for each in outcomes if each.mutant.module == module])
            for module in modules
        ),
        ("**all**", list(outcomes)),
    ]:
        died, could = score(own)
        late = sum(each.state == "timeout" for each in own)
        share = f"{100 * died / could:.0f} %" if could else ""
        lines.append(
            f"| {name} | {len(own)} | {died} | {late} | {len(own) - could} | {could - died} | {share} |"
        )
    lines += ["", "## Survivors", "", "Equivalent changes change no result; they do not count."]
    for each in outcomes:
        if each.state == "survived":
            why = f"{each.kind}: {each.reason}" if each.kind else "no reason is known"
            where = f"`{each.mutant.module}.py`, {each.mutant.spec.definition_name or 'constant'}"
            lines += ["", f"- {where}: {why}", "", "  ```diff", f"  -{each.mutant.before}"]
            lines += [f"  +{each.mutant.after}", "  ```"]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run the sample; 1 where fewer of the changes are noticed than is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    plan_path = Path(__file__).with_suffix(".toml")
    plan = tomllib.loads(plan_path.read_text(encoding="utf-8"))
    parser.add_argument("--only", nargs="+", choices=sorted(plan["tests"]), help="files (default: all)")
    parser.add_argument("--most", type=int, default=30, help="changes in each file, at most (default: 30)")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--processes", type=int, default=2, help="tests run at a time (default: 2)")
    parser.add_argument("--least", type=float, default=85.0, help="percent to be noticed (default: 85)")
    parser.add_argument("--out", type=Path, help="where the report goes (default: it is printed)")
    arguments = parser.parse_args()
    modules = arguments.only or list(plan["tests"])
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_MOST, _MEMORY_MOST))
    os.chdir(Path(__file__).parents[1])

    begin, outcomes = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.processes) as pool:
        copies = Copies(Path(folder), arguments.processes)
        for module in modules:
            tests = plan["tests"][module]
            limit_s = 60.0 + 4.0 * unchanged(copies.all[0], tests)
            mutants = sampled(module, Path("segmentation", f"{module}.py"), arguments.most, arguments.seed)
            states = pool.map(lambda each: copies.run(each, tests, limit_s), mutants)  # noqa: B023
            for mutant, state in zip(mutants, states, strict=True):
                outcomes.append(explained(mutant, state, plan["survivor"]))
                what = "" if state == "killed" else f": {mutant.before} -> {mutant.after}"
                print(f"{time.monotonic() - begin:6.0f} s  {module}  {state}{what}", flush=True)
    text = report(outcomes, modules, sys.argv[1:], time.monotonic() - begin)
    if arguments.out is None:
        print(text)
    else:
        arguments.out.write_text(text, encoding="utf-8")
    died, could = score(outcomes)
    return int(100.0 * died < arguments.least * could)


if __name__ == "__main__":
    sys.exit(main())
