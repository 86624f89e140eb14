"""Messages as bytes: dataclasses of this package, numbers, text and arrays."""

import io
import pickle
from dataclasses import is_dataclass
from enum import Enum
from typing import Any

#: What a message may hold besides this package's dataclasses, enumerations and errors.
_OTHERS = {("numpy", "dtype"), ("numpy", "ndarray")}
# Python 3.13 moved paths.
_OTHERS |= {(module, "PosixPath") for module in ("pathlib", "pathlib._local")}
_OTHERS |= {
    (f"numpy.{core}.{module}", name)
    for core in ("core", "_core")
    for module, name in (("numeric", "_frombuffer"), ("multiarray", "scalar"), ("multiarray", "_reconstruct"))
}


def encode(message: Any, file: Any) -> None:
    """Write a message to a file; large arrays are written as they are, without a copy."""
    writer = _Writer(file, protocol=5)
    # None of the functions that other packages register (Dask's does, for all errors): they would be refused.
    writer.dispatch_table = {}
    writer.dump(message)


def decode(text: bytes) -> Any:
    """Return the message that was encoded.

    Raises pickle.UnpicklingError if it names another class or function: nothing in it is run.
    """
    return _Reader(io.BytesIO(text)).load()


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
