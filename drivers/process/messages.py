"""Messages as bytes: dataclasses of numbers, text, enumerations and arrays, as JSON beside the arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Key under which an object names its class.
_CLASS = "@"
_ARRAY = "array"
#: Arrays of up to this size are part of the JSON, bytes.
_SMALL_BYTES = 512
#: The others begin at multiples of this, bytes.
_ALIGNMENT = 16


class Codec:
    """Encodes and decodes messages of some classes.

    Nothing else can be decoded, so that bytes cannot make the reader run anything.

    Parameters
    ----------
    *classes : type
        Dataclasses; those that their fields name are included.

    Raises
    ------
    ValueError
        If two of them have the same name.
    """

    def __init__(self, *classes: type) -> None:
        self._classes: dict[str, type] = {}
        self._enumerations: dict[str, dict[str, type[Enum]]] = {}
        for each in classes:
            self._include(each)

    def _include(self, hint: Any) -> None:
        for part in get_args(hint):
            self._include(part)
        if not (isinstance(hint, type) and is_dataclass(hint)) or self._classes.get(hint.__name__) is hint:
            return
        if hint.__name__ in self._classes:
            raise ValueError(f"{hint.__name__}: two classes have this name")
        self._classes[hint.__name__] = hint
        enumerations = self._enumerations[hint.__name__] = {}
        for name, part in get_type_hints(hint).items():
            self._include(part)
            for each in (part, *get_args(part)):
                if isinstance(each, type) and issubclass(each, Enum):
                    enumerations[name] = each

    def encode(self, message: Any) -> tuple[bytes, list[NDArray[Any]]]:
        """Return a message as JSON, and its arrays, but for very small ones, in their order.

        Raises
        ------
        TypeError
            If it holds a value of another kind.
        """
        arrays: list[NDArray[Any]] = []

        def described(value: Any) -> Any:
            if isinstance(value, Enum):
                return value.value
            if is_dataclass(value):
                content = {each.name: getattr(value, each.name) for each in fields(value)}
                return {_CLASS: type(value).__name__, **content}
            if isinstance(value, Mapping):
                return dict(value)
            if not hasattr(value, "__array_interface__"):
                raise TypeError(f"expected numbers, text, arrays and dataclasses, got {type(value).__name__}")
            if not value.shape:
                return value.item()
            description = {_CLASS: _ARRAY, "dtype": value.dtype.str, "shape": value.shape}
            if value.nbytes <= _SMALL_BYTES:
                return description | {"values": value.ravel().tolist()}
            arrays.append(value if value.flags.c_contiguous else value.copy())
            return description

        return json.dumps(message, default=described).encode(), arrays

    def decode(self, text: bytes, body: memoryview) -> Any:
        """Return the message that was encoded; its arrays are copied from `body`.

        Raises
        ------
        ValueError
            If it is not a message of these classes.
        """
        offset = 0

        def restored(values: dict[str, Any]) -> Any:
            nonlocal offset
            name = values.pop(_CLASS, None)
            if name is None:
                return values
            if name == _ARRAY:
                import numpy as np  # late: most processes wait for their first array with better to do

                if "values" in values:
                    return np.array(values["values"], values["dtype"]).reshape(values["shape"])
                array = np.ndarray(values["shape"], values["dtype"], body, offset)
                offset += aligned(array.nbytes)
                return array.copy()
            if (kind := self._classes.get(name)) is None:
                raise ValueError(f"no message is called {name!r}")
            for key, each in values.items():
                if isinstance(each, list):
                    values[key] = tuple(each)  # JSON knows no tuples, and messages hold no lists
            for key, enumeration in self._enumerations[name].items():
                if values[key] is not None:
                    values[key] = enumeration(values[key])
            return kind(**values)

        return json.loads(text, object_hook=restored)


def aligned(size: int) -> int:
    """Return the room that an array of `size` bytes takes beside others, bytes."""
    return -(-size // _ALIGNMENT) * _ALIGNMENT


__all__ = ["Codec", "aligned"]
