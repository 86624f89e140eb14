import ast
import importlib
import inspect
import pkgutil

import pytest

import nurbseg.drivers
import nurbseg.segmentation

#: The degree of a cubic does not change.
LASTING = {"CUBIC"}


def modules():
    for package in (nurbseg.drivers, nurbseg.segmentation):
        for info in pkgutil.iter_modules(package.__path__):
            yield importlib.import_module(f"{package.__name__}.{info.name}")


@pytest.mark.parametrize(
    "module", list(modules()), ids=lambda module: module.__name__.removeprefix("nurbseg.")
)
def test_compiled_functions_take_nothing_from_other_files(module):
    """What is kept of them is not compiled anew when another file changes."""
    tree = ast.parse(inspect.getsource(module))
    elsewhere = {
        each.asname or each.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("nurbseg")
        for each in node.names
    }
    for name, value in vars(module).items():
        function = getattr(value, "py_func", None)
        if function is not None and function.__module__ == module.__name__:
            assert not elsewhere.intersection(function.__code__.co_names) - LASTING, name
