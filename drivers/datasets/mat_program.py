"""A program that reads MATLAB files; `nurbseg.drivers.datasets.nyu` calls its functions.

On damaged or malicious files, the libraries that read them may crash or take any amount of memory.
"""

import functools
import os
import resource
import sys
from collections.abc import Callable
from typing import Any

from nurbseg.common.errors import BackendMissingError, FrameFormatError
from nurbseg.common.limits import CHUNK_BYTES_MAX, FRAME_BYTES_MAX, PIXELS_MAX
from nurbseg.common.process.channel import connect_to_parent
from nurbseg.common.process.codec import Codec

#: Address space, bytes: the libraries take one GiB, a frame of the largest size another.
_ADDRESS_SPACE_BYTES = 3 << 30
#: Processor time for one call, seconds.
_PROCESSOR_S = 30
#: Longest wait for this process to end, seconds.
_END_S = 2.0
#: The sets of the labeled file and their numbers for each pixel.
SETS = {"images": 3, "depths": 1, "labels": 1, "instances": 1}

CODEC = Codec()


def _limited(read: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
    """Limit the time that a function takes of the processor, and turn what it raises into our errors."""

    @functools.wraps(read)
    def limited(*arguments: Any) -> dict[str, Any]:
        used = resource.getrusage(resource.RUSAGE_SELF)
        most = int(used.ru_utime + used.ru_stime) + _PROCESSOR_S
        resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))
        try:
            return read(*arguments)
        except FrameFormatError:
            raise
        except ImportError as err:
            library = err.name or str(err)
            raise BackendMissingError(f"{library} is needed to read it: pip install {library}") from err
        # The libraries raise whatever a damaged file leads them to.
        except Exception as err:
            raise FrameFormatError(f"cannot be read ({type(err).__name__}: {err})") from err

    return limited


@_limited
def labelled_shape(path: str) -> dict[str, Any]:
    """Return the number of frames, their width and height, on which the sets of a labeled file agree."""
    shapes = {name: each.shape for name, each in _open_hdf5(path).items()}
    flat = shapes["depths"]
    if len(flat) != 3 or not all(flat):
        raise FrameFormatError(f"depths: expected (frames, columns, rows), got {flat}")
    expected = {"images": (flat[0], 3, *flat[1:]), "labels": flat, "instances": flat}
    for name, shape in expected.items():
        if shapes[name] != shape:
            raise FrameFormatError(f"{name}: expected {shape} as for depths, got {shapes[name]}")
    return {"shape": flat}


@_limited
def labelled_frame(path: str, index: int) -> dict[str, Any]:
    """Return the arrays of a frame of a labeled file."""
    return _of_frame_size({name: each[index] for name, each in _open_hdf5(path).items()})


@_limited
def single_frame(path: str) -> dict[str, Any]:
    """Return the arrays of the frame in a MATLAB 5 file."""
    import scipy.io

    record = scipy.io.loadmat(path, variable_names=["data"])["data"][0, 0]
    arrays = {name: record[name] for name in ("rgb", "realDepth")}
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu" or array.size > 3 * PIXELS_MAX:
            raise FrameFormatError(
                f"data.{name}: expected the numbers of an image, got {array.shape} {array.dtype}"
            )
    return _of_frame_size(arrays)


def _of_frame_size(arrays: dict[str, Any]) -> dict[str, Any]:
    size = sum(array.nbytes for array in arrays.values())
    if size > 2 * FRAME_BYTES_MAX:
        raise FrameFormatError(f"expected {2 * FRAME_BYTES_MAX} bytes at most, got {size}")
    return arrays


@functools.cache
def _open_hdf5(path: str) -> dict[str, Any]:
    import h5py

    file = h5py.File(path, "r")
    return {name: _hdf5_set(h5py, file, name, numbers) for name, numbers in SETS.items()}


def _hdf5_set(h5py: Any, file: Any, name: str, numbers: int) -> Any:
    import numpy as np

    if name not in file:
        raise FrameFormatError(
            f"the set {name!r} is missing, as in NYU Depth v2; export other depth as 16-bit PNG or .npy"
        )
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


def main() -> int:
    """Answer calls until the other process has finished."""
    # Neither threads, which take address space, nor filters from anywhere.
    os.environ.update(OPENBLAS_NUM_THREADS="1", HDF5_PLUGIN_PRELOAD="::")
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE_BYTES, _ADDRESS_SPACE_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    channel = connect_to_parent(CODEC, limit_s=_END_S)
    channel.serve({each.__name__: each for each in (labelled_shape, labelled_frame, single_frame)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
