"""A program that reads MATLAB files; `MatProcess` runs it.

On damaged or malicious files, the libraries that read them may crash or take any amount of memory.
"""

import contextlib
import os
import resource
import sys
from dataclasses import dataclass, field
from typing import Any, Literal

from nurbseg.drivers.errors import FrameFormatError
from nurbseg.drivers.limits import CHUNK_BYTES_MAX, FRAME_BYTES_MAX, PIXELS_MAX
from nurbseg.drivers.process.channel import ChannelClosedError, connect_to_parent
from nurbseg.drivers.process.messages import Codec

#: Address space, bytes: the libraries take one GiB, a frame of the largest size another.
_ADDRESS_SPACE_BYTES = 3 << 30
#: Processor time for one request, seconds.
_PROCESSOR_S = 30
#: Longest wait for a request before looking again, and for this process to end; seconds.
_REQUEST_S, _END_S = 60.0, 2.0
#: The sets of the labelled file and their numbers for each pixel.
SETS = {"images": 3, "depths": 1, "labels": 1, "instances": 1}

MatForm = Literal["hdf5", "matlab5"]


@dataclass(frozen=True, slots=True)
class Request:
    """Read a frame, or, without an index, the shapes of a labelled set."""

    path: str
    form: MatForm
    index: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Shapes and arrays by name; or what is wrong with the file, or which library is missing."""

    shapes: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    missing: str = ""


CODEC = Codec(Request, Answer)


def main() -> int:
    """Answer requests until the other process has finished."""
    # Neither threads, which take address space, nor filters from anywhere.
    os.environ.update(OPENBLAS_NUM_THREADS="1", HDF5_PLUGIN_PRELOAD="::")
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE_BYTES, _ADDRESS_SPACE_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    channel = connect_to_parent(CODEC, limit_s=_END_S)
    files: dict[str, Any] = {}
    with contextlib.suppress(ChannelClosedError):
        while True:
            request = channel.receive(_REQUEST_S)
            if isinstance(request, Request):
                used = resource.getrusage(resource.RUSAGE_SELF)
                most = int(used.ru_utime + used.ru_stime) + _PROCESSOR_S
                resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))
                channel.send(_answer(request, files))
    return 0


def _answer(request: Request, files: dict[str, Any]) -> Answer:
    try:
        if request.form == "matlab5":
            arrays = _matlab5(request.path)
        else:
            if request.path not in files:
                files[request.path] = _open_hdf5(request.path)
            sets = files[request.path]
            if request.index is None:
                return Answer(shapes={name: list(each.shape) for name, each in sets.items()})
            arrays = {name: each[request.index] for name, each in sets.items()}
        size = sum(each.nbytes for each in arrays.values())
        if size > 2 * FRAME_BYTES_MAX:
            raise FrameFormatError(f"expected {2 * FRAME_BYTES_MAX} bytes at most, got {size}")
        return Answer(arrays=arrays)
    except ImportError as err:
        return Answer(missing=err.name or str(err))
    except FrameFormatError as err:
        return Answer(error=str(err))
    # The libraries raise whatever a damaged file leads them to.
    except Exception as err:
        return Answer(error=f"cannot be read ({type(err).__name__}: {err})")


def _open_hdf5(path: str) -> dict[str, Any]:
    import h5py

    file = h5py.File(path, "r")
    return {name: _hdf5_set(h5py, file, name, numbers) for name, numbers in SETS.items()}


def _hdf5_set(h5py: Any, file: Any, name: str, numbers: int) -> Any:
    import numpy as np

    if name not in file:
        raise FrameFormatError(f"the set {name!r} is missing, as in nyu_depth_v2_labeled.mat")
    found = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
    if not isinstance(found, h5py.Dataset) or found.external or found.is_virtual:
        raise FrameFormatError(f"{name}: expected an array within the file")
    if found.dtype.kind not in "fiu" or found.dtype.itemsize > 8:
        raise FrameFormatError(f"{name}: expected numbers, got {found.dtype}")
    if np.prod(found.shape[1:], dtype=float) > numbers * PIXELS_MAX:
        raise FrameFormatError(f"{name}: expected {PIXELS_MAX} pixels at most, got {found.shape}")
    if found.chunks and np.prod(found.chunks, dtype=float) * found.dtype.itemsize > CHUNK_BYTES_MAX:
        raise FrameFormatError(
            f"{name}: expected chunks of {CHUNK_BYTES_MAX} bytes at most, got {found.chunks}"
        )
    return found


def _matlab5(path: str) -> dict[str, Any]:
    import scipy.io

    record = scipy.io.loadmat(path, variable_names=["data"])["data"][0, 0]
    arrays = {name: record[name] for name in ("rgb", "realDepth")}
    for name, each in arrays.items():
        if each.dtype.kind not in "fiu" or each.size > 3 * PIXELS_MAX:
            raise FrameFormatError(
                f"data.{name}: expected the numbers of an image, got {each.shape} {each.dtype}"
            )
    return arrays


if __name__ == "__main__":
    sys.exit(main())
