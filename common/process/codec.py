"""Messages as bytes: objects of this package, numbers, text and arrays."""

import io
import pickle
from collections.abc import Sequence
from dataclasses import is_dataclass
from enum import Enum
from typing import Any

#: Arrays of up to this size are among a message's other values, bytes.
_SMALL_BYTES = 512
#: What a message may hold besides this package's dataclasses, enumerations and errors.
_OTHERS = {("numpy", "dtype"), ("numpy", "ndarray")}
# Python 3.13 moved paths.
_OTHERS |= {(module, "PosixPath") for module in ("pathlib", "pathlib._local")}
_OTHERS |= {
    (f"numpy.{core}.{module}", name)
    for core in ("core", "_core")
    for module, name in (("numeric", "_frombuffer"), ("multiarray", "scalar"), ("multiarray", "_reconstruct"))
}


def encode(message: Any, *, parts_max: int = 1) -> list[memoryview]:
    """Return a message as bytes, in up to `parts_max` parts: each large array may be one of its own."""
    arrays: list[memoryview] = []

    def keep(buffer: pickle.PickleBuffer) -> bool:
        """Return whether an array stays among the other values."""
        raw = buffer.raw()
        if is_small := raw.nbytes <= _SMALL_BYTES or len(arrays) + 1 >= parts_max:
            return is_small
        arrays.append(raw)
        return False

    text = io.BytesIO()
    writer = _Writer(text, protocol=5, buffer_callback=keep)
    # None of the functions that other packages register (Dask's does, for all errors): they would be refused.
    writer.dispatch_table = {}
    writer.dump(message)
    return [text.getbuffer(), *arrays]


def decode(text: memoryview | bytes, arrays: Sequence[memoryview] = ()) -> Any:
    """Return the message that was encoded, whose arrays refer to the bytes that are given.

    Raises pickle.UnpicklingError if they name another class or function: nothing in them is run.
    """
    return _Reader(io.BytesIO(text), buffers=arrays).load()


class _Writer(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        """Have enumerations made of their values, which not every Python does by itself."""
        return (type(value), (value.value,)) if isinstance(value, Enum) else NotImplemented


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return a class of a message."""
        if (module, name) in _OTHERS:
            return super().find_class(module, name)
        found = super().find_class(module, name) if module.startswith(("nurbseg.", "builtins")) else None
        if isinstance(found, type) and (is_dataclass(found) or issubclass(found, Enum | Exception)):
            return found
        raise pickle.UnpicklingError(f"{module}.{name} is no message")
