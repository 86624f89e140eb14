"""Reads MATLAB files in a process of its own: ``python -P -m nurbseg.drivers.datasets.mat_program``.

The libraries that read them crash on, or take any amount of memory for, files that are damaged or made for
that. A request is a line of JSON on the standard input; the answer is one on the standard output, followed by
the bytes of the arrays that it describes. The program ends with its input.
"""

from __future__ import annotations

import json
import resource
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.limits import CHUNK_BYTES_MAX, PIXELS_MAX

#: Address space, bytes: the libraries take one GiB, a frame of the largest size another.
_ADDRESS_SPACE_BYTES = 3 << 30
#: Processor time for one request, seconds.
_PROCESSOR_S = 30
#: The sets of the labelled file and their numbers for each pixel.
SETS = {"images": 3, "depths": 1, "labels": 1, "instances": 1}

Arrays = dict[str, NDArray[Any]]


class _UnusableError(Exception):
    """The file cannot be used; the message says why."""


def main() -> None:
    """Answer requests until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE_BYTES, _ADDRESS_SPACE_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    files: dict[str, Any] = {}
    for line in sys.stdin.buffer:
        used = resource.getrusage(resource.RUSAGE_SELF)
        most = int(used.ru_utime + used.ru_stime) + _PROCESSOR_S
        resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))
        answer, arrays = _answer(json.loads(line), files)
        answer["arrays"] = {name: [each.dtype.str, each.shape] for name, each in arrays.items()}
        sys.stdout.buffer.write(json.dumps(answer).encode() + b"\n")
        for each in arrays.values():
            sys.stdout.buffer.write(np.ascontiguousarray(each).data)
        sys.stdout.buffer.flush()


def _answer(request: dict[str, Any], files: dict[str, Any]) -> tuple[dict[str, Any], Arrays]:
    path, index = request["path"], request["index"]
    try:
        if request["form"] == "matlab5":
            return {}, _matlab5(path)
        if path not in files:
            files[path] = _open_hdf5(path)
        sets = files[path]
        if index is None:
            return {"shapes": {name: each.shape for name, each in sets.items()}}, {}
        return {}, {name: each[index] for name, each in sets.items()}
    except ImportError as err:
        return {"missing": err.name or str(err)}, {}
    except _UnusableError as err:
        return {"error": str(err)}, {}
    # The libraries raise whatever a damaged file leads them to.
    except Exception as err:
        return {"error": f"cannot be read ({type(err).__name__}: {err})"}, {}


def _open_hdf5(path: str) -> dict[str, Any]:
    import h5py

    file = h5py.File(path, "r")
    return {name: _hdf5_set(h5py, file, name, numbers) for name, numbers in SETS.items()}


def _hdf5_set(h5py: Any, file: Any, name: str, numbers: int) -> Any:
    if name not in file:
        raise _UnusableError(f"the set {name!r} is missing, as in nyu_depth_v2_labeled.mat")
    found = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
    if not isinstance(found, h5py.Dataset) or found.external or found.is_virtual:
        raise _UnusableError(f"{name}: expected an array within the file")
    if found.dtype.kind not in "fiu" or found.dtype.itemsize > 8:
        raise _UnusableError(f"{name}: expected numbers, got {found.dtype}")
    if np.prod(found.shape[1:], dtype=float) > numbers * PIXELS_MAX:
        raise _UnusableError(f"{name}: expected {PIXELS_MAX} pixels at most, got {found.shape}")
    if found.chunks and np.prod(found.chunks, dtype=float) * found.dtype.itemsize > CHUNK_BYTES_MAX:
        raise _UnusableError(
            f"{name}: expected chunks of {CHUNK_BYTES_MAX} bytes at most, got {found.chunks}"
        )
    return found


def _matlab5(path: str) -> Arrays:
    import scipy.io

    record = scipy.io.loadmat(Path(path), variable_names=["data"])["data"][0, 0]
    arrays = {name: record[name] for name in ("rgb", "realDepth")}
    for name, each in arrays.items():
        if each.dtype.kind not in "fiu" or each.size > 3 * PIXELS_MAX:
            raise _UnusableError(
                f"data.{name}: expected the numbers of an image, got {each.shape} {each.dtype}"
            )
    return arrays


if __name__ == "__main__":
    main()
