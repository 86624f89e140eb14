"""Compares what a package exports with what it declares, once all of its modules are imported.

Run as a program, with the package's name: what a process has imported decides what a name is.
"""

from __future__ import annotations

import ast
import importlib
import pkgutil
import sys
from pathlib import Path


def declared(package: str) -> dict[str, tuple[str, str]]:
    """Home and own name of each name that a package declares for those who check types."""
    file = importlib.import_module(package).__file__
    assert file is not None
    return {
        alias.asname or alias.name: (node.module, alias.name)
        for node in ast.walk(ast.parse(Path(file).read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("nurbseg.")
        for alias in node.names
    }


def main(package: str) -> None:
    """Raise if a name is missing, is not declared, or is something else than declared."""
    names, module = declared(package), importlib.import_module(package)
    assert set(module.__all__) - {"__version__"} == set(names), set(module.__all__) ^ set(names)
    # A module of that name takes the place of what is exported as soon as it is imported.
    for each in pkgutil.iter_modules(module.__path__, f"{package}."):
        importlib.import_module(each.name)
    for name, (home, own) in names.items():
        found, expected = getattr(module, name), getattr(importlib.import_module(home), own)
        assert found is expected, f"{name} is {found!r}, not {expected!r}"


if __name__ == "__main__":
    main(sys.argv[1])
