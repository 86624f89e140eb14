"""Imports libraries so that they do not look for settings in the working folder."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType

#: The file that a module looks for in the working folder, and where it looks instead, beside its own source.
#: The settings can name programs and folders of code, and anybody may have left the file there.
_FILES = {
    "numba.core.config": (".numba_config.yaml", ".numba_config.yaml"),
    "matplotlib": ("matplotlibrc", "mpl-data/matplotlibrc"),
}


class _Loader(SourceFileLoader):
    """Loads a module with another name in place of its file's."""

    def get_code(self, fullname: str) -> CodeType | None:
        code = super().get_code(fullname)
        name, _ = _FILES[fullname]
        return code and _replaced(code, name, own_file(fullname, self.path))


def _replaced(code: CodeType, old: str, new: str) -> CodeType:
    """Return code with another text in place of a constant, in nested functions too."""
    constants = (
        _replaced(each, old, new) if isinstance(each, CodeType) else new if each == old else each
        for each in code.co_consts
    )
    return code.replace(co_consts=tuple(constants))


def own_file(module: str, source: str) -> str:
    """Return where a module, whose source is at this path, looks instead."""
    return str(Path(source).resolve().parent / _FILES[module][1])


class _Finder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname, path) if fullname in _FILES else None
        if spec is not None and spec.origin is not None:
            spec.loader = _Loader(fullname, spec.origin)
        return spec


@contextmanager
def left_out() -> Iterator[None]:
    """Import within the block without such files; a module that is imported already stays as it is."""
    finder = _Finder()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
