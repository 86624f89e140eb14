import ast
import importlib
import inspect
import pkgutil

import numpy as np
import pytest

import nurbseg.drivers
import nurbseg.segmentation
from nurbseg.drivers.compiled import compiled

#: The degree of a cubic does not change.
LASTING = {"CUBIC"}


def modules():
    for package in (nurbseg.drivers, nurbseg.segmentation):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            yield importlib.import_module(info.name)


def compiled_in(module):
    for name, value in vars(module).items():
        function = getattr(value, "py_func", None)
        if function is not None and function.__module__ == module.__name__:
            yield name, function.__code__


every_module = pytest.mark.parametrize(
    "module", list(modules()), ids=lambda module: module.__name__.removeprefix("nurbseg.")
)


@every_module
def test_compiled_functions_take_nothing_from_other_files(module):
    """What is kept of them is not compiled anew when another file changes."""
    tree = ast.parse(inspect.getsource(module))
    elsewhere = {
        each.asname or each.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("nurbseg")
        for each in node.names
    }
    for name, code in compiled_in(module):
        assert not elsewhere.intersection(code.co_names) - LASTING, name


@every_module
def test_compiled_functions_tell_infinities_by_comparison(module):
    """Where sums may be reordered, a sum less itself is 0, and so `isfinite` is true of it."""
    for name, code in compiled_in(module):
        assert "isfinite" not in code.co_names, name


def test_comparisons_know_a_sum_that_is_not_finite():
    values = np.array([1.0, np.nan, np.inf, -np.inf])
    assert _finite_sums(values, np.ones(4)).tolist() == [True, False, False, False]


@compiled
def _finite_sums(a, b):
    finite = np.empty(a.size, dtype=np.bool_)
    for n in range(a.size):
        finite[n] = abs(a[n] + b[n]) < np.inf
    return finite
