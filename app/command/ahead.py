"""Compiles functions into the cache on disk before the run that started it calls them."""

import gc
import importlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from nurbseg.common.compiled import from_dtype, types
from nurbseg.segmentation.live.appearance import KNOWN, SEEN

#: Number of new objects between garbage collections while compiling, which creates very many lasting ones: at
#: Python's default of 700, collections take a twentieth of the time.
GARBAGE_THRESHOLD = 100_000
#: Functions that are called from the first fit on, and the types of their arguments. The fit comes first, as
#: it is needed soon. Then come those of a frame alone and those of a live run, each from the last on: the run
#: itself compiles from the other end.
_LIST = Path(__file__).with_name("ahead.txt")


def functions() -> Iterator[tuple[Any, tuple[types.Type, ...]]]:
    """Yield functions to compile, and the types of their arguments."""
    for line in _LIST.read_text(encoding="utf-8").splitlines():
        path, _, arguments = line.partition(": ")
        module, _, name = path.rpartition(".")
        names = vars(importlib.import_module(f"nurbseg.{module}"))
        yield names[name], _types(f"{arguments},", names)


def _types(written: str, names: dict[str, Any]) -> tuple[types.Type, ...]:
    """Evaluate types as Numba writes them; named tuples are those of a module."""
    tuples = {
        name: partial(_tuple, each)
        for name, each in names.items()
        if isinstance(each, type) and issubclass(each, tuple)
    }
    records = {"KNOWN": from_dtype(KNOWN), "SEEN": from_dtype(SEEN)}
    found = eval(written, vars(types) | tuples | records | {"bool": types.boolean, "readonly": _readonly})
    return tuple(map(_nested, found))


def _nested(kind: Any) -> types.Type:
    return _tuple(None, *kind) if isinstance(kind, tuple) else kind


def _tuple(kind: type | None, *elements: Any) -> types.Type:
    found: types.Type = types.BaseTuple.from_types(tuple(map(_nested, elements)), kind)  # type: ignore[no-untyped-call]
    return found


def _readonly(array: types.Array) -> types.Array:
    return array.copy(readonly=True)


def main() -> None:
    """Compile them all."""
    gc.set_threshold(GARBAGE_THRESHOLD)
    for function, arguments in functions():
        function.compile(arguments)


if __name__ == "__main__":
    main()
