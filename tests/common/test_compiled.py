import ast
import importlib
import inspect
import os
import pkgutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import nurbseg.drivers
import nurbseg.library
import nurbseg.segmentation
from nurbseg.common import code_cache
from nurbseg.common.code_cache import content_digest
from nurbseg.common.compiled import compiled


def modules():
    for package in (nurbseg.drivers, nurbseg.library, nurbseg.segmentation):
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
def test_compiled_functions_take_names_only_from_files_by_whose_content_their_code_is_kept(module):
    elsewhere = {}
    for node in ast.parse(inspect.getsource(module)).body:
        if not isinstance(node, ast.ImportFrom) or node.module == "nurbseg.common.compiled":
            continue  # that one passes on Numba's own names
        if (node.module or "").startswith("nurbseg"):
            elsewhere |= {name.asname or name.name: node.module for name in node.names}
    for name, code in compiled_in(module):
        for used in elsewhere.keys() & set(code.co_names):
            source = inspect.getsource(importlib.import_module(elsewhere[used]))
            assert "\n@compiled" in source or "\n@inlined" in source, (name, used)


@every_module
def test_compiled_functions_recognize_infinities_by_comparison(module):
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


INNER = """
from nurbseg.common.compiled import compiled

@compiled
def inner(x):
    return x + {number}
"""
OUTER = """
from nurbseg.common.compiled import compiled
from nurbseg.segmentation.inner import inner

@compiled
def outer(x):
    return 10 * inner(x)
"""
PROGRAM = """
import sys
from pathlib import Path
import nurbseg.segmentation
nurbseg.segmentation.__path__.append(sys.argv[1] + "/segmentation")
from nurbseg.common import code_cache
code_cache._PACKAGES = Path(sys.argv[1])
from nurbseg.segmentation.outer import outer
print(outer(1), sum(outer.stats.cache_hits.values()))
"""


@pytest.fixture(autouse=True)
def no_bytecode_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python would take a file of the same second and size for the one before."""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")


def run(folder: Path, number: int) -> list[str]:
    """Write the files with a number, and run them: the result, and how often code was found."""
    (folder / "segmentation").mkdir(exist_ok=True)
    (folder / "segmentation/outer.py").write_text(OUTER)
    (folder / "segmentation/inner.py").write_text(INNER.format(number=number))
    command = [sys.executable, "-c", PROGRAM, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout.split()


def test_code_is_recompiled_when_a_function_of_another_file_changes(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "code"))
    assert run(tmp_path, 1) == ["20", "0"]
    assert run(tmp_path, 1) == ["20", "1"]
    assert run(tmp_path, 2) == ["30", "0"]
    # What cannot be removed stays.
    (tmp_path / "code/loops-file").touch()
    assert [run(tmp_path, number)[0] for number in (3, 4)] == ["40", "50"]
    # Another process may still use those of this day.
    assert len(list((tmp_path / "code").glob("loops-*/"))) == 4
    two_days_ago_s = time.time() - 2 * 24 * 3600
    for used in (tmp_path / "code").glob("loops-*/used"):
        os.utime(used, (two_days_ago_s, two_days_ago_s))
    assert run(tmp_path, 5)[0] == "60"
    kept = sorted(path.name for path in (tmp_path / "code").glob("loops-*/"))
    assert len(kept) == 3
    assert f"loops-{content_digest(tmp_path)}" in kept


LOST = """
import shutil, sys
from pathlib import Path
from nurbseg.common.compiled import compiled

@compiled
def double(x):
    return 2 * x

folder = Path(double.stats.cache_path)
shutil.rmtree(folder)
folder.touch()
print(double(4))
"""


def test_code_runs_where_it_can_no_longer_be_kept(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "code"))
    (tmp_path / "lost.py").write_text(LOST)
    done = subprocess.run([sys.executable, tmp_path / "lost.py"], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("8\n", "")


ELSEWHERE = """
import sys
from pathlib import Path
from nurbseg.common import code_cache
code_cache._PACKAGES = Path(sys.argv[1]) / "packages"
sys.path.insert(0, sys.argv[1] + "/own")
from outer import outer
print(outer(1), sum(outer.stats.cache_hits.values()))
"""


def test_code_of_a_program_is_kept_by_what_lies_beside_it(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "code"))
    (tmp_path / "own").mkdir()
    (tmp_path / "own/outer.py").write_text(OUTER.replace("nurbseg.segmentation.inner", "inner"))
    found = []
    for number in (1, 1, 2):
        (tmp_path / "own/inner.py").write_text(INNER.format(number=number))
        done = subprocess.run(
            [sys.executable, "-c", ELSEWHERE, str(tmp_path)], capture_output=True, text=True, timeout=120
        )
        found.append(done.stdout.split())
    assert found == [["20", "0"], ["20", "1"], ["30", "0"]]


def test_code_is_cached_in_the_users_cache_unless_somebody_else_can_enter_it(tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert run(tmp_path, 1) == ["20", "0"]
    (code,) = tmp_path.rglob("loops-*")
    assert code.parent == tmp_path / "cache/nurbseg"
    assert run(tmp_path, 1) == ["20", "1"]
    code.parent.chmod(0o755)
    assert run(tmp_path, 1) == ["20", "0"]


def test_a_user_without_a_home_caches_nothing_and_is_told_so(tmp_path, monkeypatch):
    def unknown(uid):
        raise KeyError(uid)

    for name in ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", unknown)
    monkeypatch.setattr(code_cache, "_folder", code_cache._folder.__wrapped__)
    monkeypatch.chdir(tmp_path)
    assert "no home folder" in code_cache.cache_error()
    assert compiled(lambda x: x + 1)(2) == 3
    assert not list(tmp_path.iterdir())


def test_only_files_with_compiled_functions_count(tmp_path: Path):
    (tmp_path / "segmentation").mkdir()
    (tmp_path / "segmentation/inner.py").write_text(INNER.format(number=1))
    before = content_digest(tmp_path)
    (tmp_path / "segmentation/other.py").write_text("x = 1\n")
    assert content_digest(tmp_path) == before
    (tmp_path / "segmentation/inner.py").write_text(INNER.format(number=2))
    assert content_digest(tmp_path) != before


#: A pickle in place of an index of Numba's cache: whoever reads it makes the file `ran`.
PLANTED = """
import os, pickle, sys
from pathlib import Path

class Code:
    def __reduce__(self):
        return os.mkdir, (sys.argv[2],)

for index in Path(sys.argv[1]).rglob("*.nbi"):
    with index.open("rb") as file:
        version = pickle.load(file)
    index.write_bytes(pickle.dumps(version) + pickle.dumps(Code()))
"""


def plant(folder: Path, ran: Path) -> None:
    subprocess.run([sys.executable, "-c", PLANTED, str(folder), str(ran)], timeout=60, check=True)


def test_code_in_a_folder_that_others_can_write_is_not_run(tmp_path, monkeypatch):
    ran = tmp_path / "ran"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "code"))
    assert run(tmp_path, 1) == ["20", "0"]
    plant(tmp_path / "code", ran)
    (tmp_path / "code").chmod(0o777)
    assert run(tmp_path, 1) == ["20", "0"]
    assert not ran.exists()
    # The same files would have run.
    (tmp_path / "code").chmod(0o700)
    subprocess.run([sys.executable, "-c", PROGRAM, str(tmp_path)], capture_output=True, timeout=120)
    assert ran.exists()


@pytest.mark.parametrize("before", ["", "import numba\n"])
def test_the_working_folder_decides_nothing_about_compiled_code(tmp_path, monkeypatch, before):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "stranger"
    folder.mkdir()
    lines = (
        f"cache_dir: {folder}/code",
        "cache_locator_classes: json.JSONDecoder",
        "disable_jit: 1",
        "boundscheck: 1",
    )
    (folder / ".numba_config.yaml").write_text("\n".join(lines))
    monkeypatch.chdir(folder)
    program = "\nfrom nurbseg.common.compiled import config; print(config.DISABLE_JIT, config.BOUNDSCHECK)"
    monkeypatch.setitem(globals(), "PROGRAM", before + PROGRAM + program)
    # Compiled, since it counts what was found.
    assert run(tmp_path, 1) == ["20", "0", "0", "None"]
    assert [path.name for path in folder.iterdir()] == [".numba_config.yaml"]
    assert list((tmp_path / "cache/nurbseg").glob("loops-*"))


def test_a_file_of_settings_that_cannot_be_read_does_not_matter(tmp_path, monkeypatch):
    (tmp_path / ".numba_config.yaml").write_text("- [")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "code"))
    assert run(tmp_path, 1) == ["20", "0"]
    alone = subprocess.run([sys.executable, "-c", "import numba"], capture_output=True, timeout=60)
    assert alone.returncode != 0
