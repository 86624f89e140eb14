"""The kinds of value that a setting can hold, read from a flag's text or from a TOML value."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from nurbseg.drivers.errors import quoted
from nurbseg.drivers.settings import subsections


@dataclass(frozen=True, slots=True)
class ValueKind:
    """What a setting's type annotation allows.

    Parameters
    ----------
    kind : type
        bool, int, float or str: of the value, or of each of its numbers.
    optional : bool
        Whether it may be left unset (None).
    length : int
        How many numbers it holds, 0 for a single value.
    word : str
        What may stand in place of a number; "" for nothing.
    """

    kind: type
    optional: bool = False
    length: int = 0
    word: str = ""

    def from_text(self, text: str) -> Any:
        """Return the value of a flag's text; raises ValueError where that is of another kind."""
        if self.length:
            return self._checked(tuple(self._number(part) for part in text.split(",")), text)
        return text if self.kind is str or text == self.word else self._number(text)

    def from_toml(self, value: Any) -> Any:
        """Return the value of what a TOML file holds; raises ValueError where that is of another kind."""
        if self.length:
            if not isinstance(value, list):
                raise ValueError(f"expected {self.words}, got {quoted(value)}")
            return self._checked(tuple(ValueKind(self.kind).from_toml(each) for each in value), value)
        if self.word and value == self.word:
            return value
        whole = isinstance(value, int) and not isinstance(value, bool)
        if self.kind is float and (whole or isinstance(value, float)):
            try:
                return self._finite(float(value), value)
            except OverflowError:
                raise ValueError(f"expected {self.words} of a float's range, got {quoted(value)}") from None
        if whole if self.kind is int else isinstance(value, self.kind):
            return value
        raise ValueError(f"expected {self.words}, got {quoted(value)}")

    @property
    def words(self) -> str:
        """What is expected, for a message."""
        names = {bool: "true or false", int: "a whole number", float: "a number", str: "a text in quotes"}
        either = f" or {self.word}" if self.word else ""
        numbers = f"{self.length} {'whole ' if self.kind is int else ''}numbers"
        return numbers if self.length else names[self.kind] + either

    def _number(self, text: str) -> float:
        try:
            number: float = self.kind(text)
        except ValueError:
            raise ValueError(f"expected {self.words}, got {text!r}") from None
        return self._finite(number, text)

    def _finite(self, number: float, given: object) -> float:
        if not math.isfinite(number):
            raise ValueError(f"expected a finite number, got {given}")
        return number

    def _checked(self, numbers: tuple[float, ...], given: object) -> tuple[float, ...]:
        if len(numbers) != self.length:
            raise ValueError(f"expected {self.words}, got {quoted(given)}")
        return numbers


def value_kinds(section: type[Any]) -> dict[str, ValueKind]:
    """Return the kind of each field of a section.

    Raises
    ------
    TypeError
        If a field's annotation is none that a flag and a TOML value can express.
    """
    hints = get_type_hints(section)
    return {
        each.name: _kind_of(hints[each.name])
        for each in fields(section)
        if each.name not in subsections(section)
    }


def _kind_of(hint: Any) -> ValueKind:
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType) and len(inner) == 2 and NoneType in inner:
        present = _kind_of(next(each for each in inner if each is not NoneType))
        return ValueKind(present.kind, optional=True, length=present.length)
    if origin in (Union, UnionType) and inner[0] is int and get_origin(inner[1]) is Literal:
        return ValueKind(int, word=get_args(inner[1])[0])
    if origin is Literal:
        return ValueKind(str)
    if origin is tuple and set(inner) in ({float}, {int}):
        return ValueKind(inner[0], length=len(inner))
    if hint in (bool, int, float, str):
        return ValueKind(hint)
    raise TypeError(f"a setting cannot be of the type {hint}")
