"""Whether the tests notice: places of the code are changed one at a time, and the tests must fail each time.

The operators are those of Cosmic Ray. What is changed is a copy of the installed package, whose compiled
functions are compiled again with it, as are those that call them; tests and source are left alone.

Examples
--------
All files, and two places of each of the drivers'::

    python benchmarks/mutation.py
    python benchmarks/mutation.py --most 2 --only drivers
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
import importlib
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
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cosmic_ray.plugins
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.ast.ast_query import ASTQuery
from cosmic_ray.mutating import mutate_code, use_mutation
from cosmic_ray.testing import run_tests
from cosmic_ray.work_item import MutationSpec, TestOutcome
from mutation_report import Mutant, Outcome, explained, is_within, report, score, source_of

import nurbseg
from nurbseg.common.code_cache import content_digest

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


def changes(source: str, path: Path) -> Iterator[tuple[MutationSpec, Any]]:
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
    for spec, operator in changes(source, path):
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
        " ".join(" ".join(line[2:] for line in lines if line[0] == sign).split()) for sign in "-+"
    )
    return Mutant(module, spec, before, after)


class Copy:
    """A copy of the installed package in which changes are made, with the machine code of its loops."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._code, self._unchanged = folder, folder / "code", folder / "unchanged"
        self._package = folder / "nurbseg"
        self._environment = ["env", f"PYTHONPATH={folder}", f"NUMBA_CACHE_DIR={self._code}"]
        for package in ("app", "common", "drivers", "evaluation", "library", "recordings", "segmentation"):
            (source,) = importlib.import_module(f"nurbseg.{package}").__path__
            shutil.copytree(source, self._package / package, ignore=shutil.ignore_patterns("__pycache__"))
        # Without it, the installed one would be found first, and no change be seen.
        shutil.copy(nurbseg.__file__, self._package)

    def measure(self, tests: Sequence[str]) -> float:
        """Run tests without a change, which must pass, and keep the machine code; return the seconds."""
        find = [*self._environment, sys.executable, "-c", "import nurbseg; print(nurbseg.__file__)"]
        found = subprocess.run(find, capture_output=True, text=True, check=True).stdout.strip()
        if not Path(found).is_relative_to(self._package):
            raise SystemExit(f"the tests would run {found}, not the copy in {self._package}")
        begin = time.monotonic()
        run = subprocess.run(self._command(tests), capture_output=True, text=True, timeout=1800)
        if run.returncode:
            raise SystemExit(f"the tests fail without any change:\n{run.stdout}")
        took_s = time.monotonic() - begin
        self._link(self._code / f"loops-{content_digest(self._package)}", self._unchanged)
        return took_s

    def test(self, mutant: Mutant, tests: Sequence[str], timeout_s: float) -> str:
        """Make a change, run tests, and take it back; return what became of it."""
        path = self._package / source_of(mutant.module)
        before = path.stat()
        operator = cosmic_ray.plugins.get_operator(mutant.spec.operator_name)()
        with use_mutation(path, operator, mutant.spec.occurrence):
            self._keep_machine_code_beside(path)
            outcome, output = run_tests(shlex.join(self._command(tests)), timeout_s)
        # Numba tells by its time whether a file is the one that it has compiled.
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        if outcome is TestOutcome.INCOMPETENT:
            raise SystemExit(f"{mutant.module}: {mutant.after}: the tests did not run: {output}")
        return (
            "survived" if outcome is TestOutcome.SURVIVED else "timeout" if output == "timeout" else "killed"
        )

    def _command(self, tests: Sequence[str]) -> list[str]:
        pytest = str(Path(sys.executable).parent / "pytest")
        return [*self._environment, pytest, "-x", "-q", "-p", "no:cacheprovider", *tests]

    def _keep_machine_code_beside(self, changed: Path) -> None:
        """Lay out the code of all loops that do not call those of a changed file."""
        shutil.rmtree(self._code, ignore_errors=True)
        folder = self._code / f"loops-{content_digest(self._package)}"
        self._link(self._unchanged, folder)
        concerned, grown = {changed}, True
        while grown:
            names = {each.relative_to(self._package).with_suffix("").as_posix() for each in concerned}
            imports = [f"from nurbseg.{name.replace('/', '.')} import" for name in names]
            users = {
                path
                for path in self._package.rglob("*.py")
                if any(line in (text := path.read_text(encoding="utf-8")) for line in imports)
                and "\n@compiled" in text
            }
            grown = not users <= concerned
            concerned |= users
        for path in concerned:
            for code in folder.rglob(f"{path.stem}.*"):
                code.unlink()

    @staticmethod
    def _link(source: Path, target: Path) -> None:
        """Add what a folder holds to another; Numba replaces files, it does not write into them."""
        for path in source.rglob("*.nb?"):
            there = target / path.relative_to(source)
            there.parent.mkdir(parents=True, exist_ok=True)
            if not there.exists():
                os.link(path, there)


def main() -> int:
    """Run the sample; 1 where fewer of the changes are noticed than is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    plan_path = Path(__file__).with_suffix(".toml")
    plan = tomllib.loads(plan_path.read_text(encoding="utf-8"))
    parser.add_argument("--only", nargs="+", default=[""], help="files or folders of them (default: all)")
    parser.add_argument("--most", type=int, default=30, help="changes in each file, at most (default: 30)")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--processes", type=int, default=2, help="tests run at a time (default: 2)")
    parser.add_argument("--least", type=float, default=85.0, help="percent to be noticed (default: 85)")
    parser.add_argument("--out", type=Path, help="where the report goes (default: it is printed)")
    arguments = parser.parse_args()
    modules = list(
        dict.fromkeys(test for only in arguments.only for test in plan["tests"] if is_within(test, only))
    )
    if not modules:
        parser.error(f"--only: {plan_path.name} lists no file of {' '.join(arguments.only)}")
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_MOST, _MEMORY_MOST))
    os.chdir(Path(__file__).parents[1])

    begin, outcomes = time.monotonic(), list[Outcome]()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.processes) as pool:
        copies = [Copy(Path(folder, str(number))) for number in range(arguments.processes)]
        free: queue.Queue[Copy] = queue.Queue()
        for copy in copies:
            free.put(copy)

        def state_of(mutant: Mutant, tests: Sequence[str], limit_s: float) -> str:
            copy = free.get(timeout=3600.0)
            try:
                return copy.test(mutant, tests, limit_s)
            finally:
                free.put(copy)

        for module in modules:
            tests = plan["tests"][module]
            # The first run compiles what the tests need.
            limit_s = 60.0 + 4.0 * max(pool.map(lambda copy, tests=tests: copy.measure(tests), copies))
            mutants = sampled(module, source_of(module), arguments.most, arguments.seed)
            states = pool.map(lambda each, tests=tests, s=limit_s: state_of(each, tests, s), mutants)
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
