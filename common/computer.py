"""The processor, BLAS kernels, threads and library versions that results and times depend on."""

import os
from collections.abc import Iterable, Iterator, MutableMapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

_CPU_INFO = Path("/proc/cpuinfo")
_PACKAGES = ("nurbseg", "numpy", "scipy", "opencv-python-headless", "rerun-sdk", "mcap")
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
#: The kernel of OpenBLAS that every processor with AVX2 and FMA can run.
_COMMON_KERNEL = "Haswell"


def pin_blas_kernel(environment: MutableMapping[str, str] = os.environ, cpu_info: Path = _CPU_INFO) -> None:
    """Let OpenBLAS use the kernel that most processors support, so that tables are reproducible.

    Kernels of newer processors sum in another order, which sometimes moves a pixel to the other side of a cut
    and changes a tree. Overrides the user's setting. Call this before numpy is imported; it affects only
    OpenBLAS on x86-64 with AVX2 and FMA.
    """
    if {"avx2", "fma"} <= set(_cpu_line("flags", cpu_info).split()):
        environment["OPENBLAS_CORETYPE"] = _COMMON_KERNEL


def limit_blas_threads(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let matrix products use one thread, unless the user has set another number.

    The segmentation's matrices are small: several threads take longer than one, and much longer if the camera
    or the viewer needs the processor. Call this before numpy is imported.
    """
    if not any(name in environment for name in _THREADS):
        environment.update(dict.fromkeys(_THREADS, "1"))


@cache
def _blas_libraries() -> "ThreadpoolController":
    # NumPy and SciPy each bring their own library; this import loads SciPy's.
    import scipy.linalg.lapack  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


#: Blocks of `one_blas_thread` that run, and the setting of BLAS before the first of them.
_blocks: list[object] = []
_found: list[Any] = []
_blocks_lock = Lock()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS use one thread in this process while the block, or one in another thread, runs.

    How a product is divided among threads changes its rounding, which can move a point to the other side of a
    cut, and so change the tree. More threads would not be faster: the matrices are small, and on a busy
    computer threads wait for each other far longer than they compute.
    """
    block = object()
    try:
        with _blocks_lock:
            if not _blocks:
                _take_control()
                _found.append(_blas_libraries().limit(limits=1))
            _blocks.append(block)
        yield
    finally:
        with _blocks_lock:
            if block in _blocks:
                _blocks.remove(block)
            if not _blocks and _found:
                _take_control()
                _found.pop().restore_original_limits()


def _take_control() -> None:
    """Let this thread set the number of threads, which threadpoolctl 3.8 reserves to the first that did."""
    for library in _blas_libraries().lib_controllers:
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)


def leave_a_core(threads: Iterable[Thread]) -> None:
    """Keep threads, and what they start later, off one core that this process may use.

    The scheduler shares cores fairly, so that a thread which is nearly always busy waits often where several
    others work for a moment each. Where there is one core only, nothing changes.

    Parameters
    ----------
    threads : iterable of Thread
        Of this process; one that has not begun or has ended is passed over.
    """
    cores = os.sched_getaffinity(os.getpid())
    for thread in threads:
        if thread.native_id is not None:
            with suppress(OSError):  # It has ended, or the system does not let it choose.
                os.sched_setaffinity(thread.native_id, cores - {max(cores)} or cores)


def process_count(workers: int | Literal["auto"]) -> int:
    """Return the number of processes that a setting asks for."""
    return len(os.sched_getaffinity(0)) if workers == "auto" else workers


def computer() -> str:
    """Return the processor and the BLAS kernels of this process as one line."""
    import platform

    # NumPy and SciPy each have their own library.
    import scipy.linalg.lapack  # noqa: F401
    from threadpoolctl import threadpool_info

    kernels = {
        f"{each['internal_api']} {each.get('architecture', 'of unknown kernel')}"
        for each in threadpool_info()
        if each["user_api"] == "blas"
    }
    processor = _cpu_line("model name", _CPU_INFO) or platform.processor() or platform.machine()
    return f"{processor}, {' and '.join(sorted(kernels)) or 'BLAS unknown'}"


@cache
def made_by() -> str:
    """Return the version of the program and the `computer`: where these are the same, so are results."""
    return f"nurbseg {versions(['nurbseg']).get('nurbseg', 'of unknown version')}, {computer()}"


def versions(packages: Iterable[str] = _PACKAGES) -> dict[str, str]:
    """Return the versions of Python, the platform and the installed packages."""
    import platform
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def versions_line() -> str:
    """Return the versions that results depend on as one line."""
    packages = ("nurbseg", "numpy", "scipy", "opencv-python-headless", "scikit-image", "scikit-learn")
    found = versions(packages)
    return ", ".join(
        [
            f"Python {found['python']}",
            *(f"{package} {found[package]}" for package in packages if package in found),
        ]
    )


def _cpu_line(name: str, cpu_info: Path) -> str:
    """Return a property of the first processor, or an empty text."""
    try:
        lines = cpu_info.read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.split(":")[0].strip() == name), "")
