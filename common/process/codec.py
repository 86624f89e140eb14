"""Messages as bytes: dataclasses of numbers, text, enumerations and arrays, as JSON beside the arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from nurbseg.common import errors
from nurbseg.common.errors import DriverError

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Keys under which an object names its class, and holds its fields in their order.
_CLASS, _CONTENT = "@", "of"
_ARRAY = "array"
#: Arrays of up to this size are part of the JSON, bytes.
_SMALL_BYTES = 512
#: The others begin at multiples of this, bytes.
_ALIGNMENT = 16


@dataclass(frozen=True, slots=True, eq=False)
class Call:
    """Call a function of the other process, by a name that both know."""

    function: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What a function has returned, or the class and text of the `DriverError` that it has raised."""

    function: str
    value: Any = None
    error: str = ""
    text: str = ""

    @property
    def raised(self) -> DriverError | None:
        """The error that the function has raised, if it has."""
        if not self.error:
            return None
        kind: type[DriverError] = getattr(errors, self.error)
        return kind(self.text)

    def result(self) -> Any:
        """Return the value, or raise the error."""
        if self.raised is not None:
            raise self.raised
        return self.value


class Codec:
    """Encodes and decodes messages of some dataclasses, and of those that their fields name.

    `Call` and `Answer` are among them.

    Nothing else can be decoded, so that bytes cannot make the reader run anything. Raises ValueError if two
    of them have the same name.
    """

    def __init__(self, *classes: type) -> None:
        self._classes: dict[str, type] = {}
        self._fields: dict[type, list[str]] = {}
        self._enumerations: dict[type, dict[int, type[Enum]]] = {}
        for class_ in (Call, Answer, *classes):
            self._include(class_)

    def _include(self, hint: Any) -> None:
        for part in get_args(hint):
            self._include(part)
        if not (isinstance(hint, type) and is_dataclass(hint)) or self._classes.get(hint.__name__) is hint:
            return
        if hint.__name__ in self._classes:
            raise ValueError(f"{hint.__name__}: two classes have this name")
        self._classes[hint.__name__] = hint
        self._fields[hint] = [field.name for field in fields(hint)]
        enumerations = self._enumerations[hint] = {}
        hints = get_type_hints(hint)
        for place, name in enumerate(self._fields[hint]):
            self._include(hints[name])
            for each in (hints[name], *get_args(hints[name])):
                if isinstance(each, type) and issubclass(each, Enum):
                    enumerations[place] = each

    def encode(self, message: Any) -> tuple[bytes, list[NDArray[Any]]]:
        """Return a message as JSON, and its arrays, but for very small ones, in their order.

        Raises TypeError if it holds a value of another kind.
        """
        arrays: list[NDArray[Any]] = []

        def described(value: Any) -> Any:
            if (names := self._fields.get(type(value))) is not None:
                return {_CLASS: type(value).__name__, _CONTENT: [getattr(value, name) for name in names]}
            if isinstance(value, Enum):
                return value.value
            if isinstance(value, Mapping):
                return dict(value)
            if not hasattr(value, "__array_interface__"):
                raise TypeError(f"expected numbers, text, arrays and messages, got {type(value).__name__}")
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

        Raises ValueError if it is not a message of these classes.
        """
        offset = 0

        def restored(values: dict[str, Any]) -> Any:
            nonlocal offset
            name = values.get(_CLASS)
            if name is None:
                return values
            if name == _ARRAY:
                import numpy as np  # late: most processes start without an array

                if "values" in values:
                    return np.array(values["values"], values["dtype"]).reshape(values["shape"])
                array = np.ndarray(values["shape"], values["dtype"], body, offset)
                offset += aligned(array.nbytes)
                return array.copy()
            if (kind := self._classes.get(name)) is None:
                raise ValueError(f"no message is called {name!r}")
            # JSON has no tuples, and messages hold no lists.
            content = [tuple(value) if type(value) is list else value for value in values[_CONTENT]]
            for place, enumeration in self._enumerations[kind].items():
                if content[place] is not None:
                    content[place] = enumeration(content[place])
            return kind(*content)

        return json.loads(text, object_hook=restored)


def aligned(size: int) -> int:
    """Return the room that an array of `size` bytes takes beside others, bytes."""
    return -(-size // _ALIGNMENT) * _ALIGNMENT
