"""Settings: dataclass fields that are described by a text, unit, bounds and symbol.

The command line, the configuration file and the checks are all made from these descriptions; values are read
by the fields' types.
"""

import math
import operator
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from ipaddress import ip_address
from types import MappingProxyType, NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from nurbseg.common.errors import quoted

#: How a switch is written where flags and TOML have no word of their own for it.
_SWITCH = {"1": True, "true": True, "0": False, "false": False}
_BOUNDS = (
    ("above", "more than", operator.gt),
    ("least", "at least", operator.ge),
    ("most", "at most", operator.le),
)


def setting(
    default: Any,
    text: str,
    *,
    unit: str = "",
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    symbol: str = "",
    flag: str = "",
) -> Any:
    """Describe one field of a configuration.

    `text` is what it means, for a person. A `unit` in capitals (``FILE``) is a placeholder: it stands for
    what is to be given, in the help only. The value must be at least `least`, at most `most` and more than
    `above`; a Literal must be one of its words. `symbol` is the literature's name of it, a second name for
    the flag; `flag` is the flag's name where it is not the field's (``duration`` for ``duration_s``).
    """
    return field(
        default=default,
        metadata={
            "text": text,
            "unit": unit,
            "least": least,
            "most": most,
            "above": above,
            "choices": (),
            "symbol": symbol,
            "flag": flag,
        },
    )


class Settings:
    """A configuration of described fields and of sections; its dataclasses are frozen.

    Raises ValueError if a value is out of its bounds; names the field, the value and what is expected.
    """

    __slots__ = ()

    def __init_subclass__(cls) -> None:
        for name, hint in get_type_hints(cls).items():
            described = vars(cls).get(name)
            # Of a Literal that may be left unset, too.
            for words in (hint, *get_args(hint)[:1]):
                if isinstance(described, Field) and get_origin(words) is Literal:
                    described.metadata = MappingProxyType({**described.metadata, "choices": get_args(words)})

    def __post_init__(self) -> None:
        for each in described_fields(type(self)):
            bounds = each.metadata
            value = getattr(self, each.name)
            if value is None and each.default is not None:
                raise ValueError(f"{each.name}: expected a value, got None")
            if value is not None and bounds["choices"] and value not in bounds["choices"]:
                raise ValueError(f"{each.name}: {not_one_of(bounds['choices'], value)}")
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            for bound, words, holds in _BOUNDS:
                if bounds[bound] is not None and not holds(value, bounds[bound]):
                    raise ValueError(f"{each.name}: expected {words} {bounds[bound]}, got {value}")
            # A whole number may be too large to be a float at all.
            if not abs(value) <= sys.float_info.max:
                raise ValueError(f"{each.name}: expected a finite number, got {quoted(value)}")
            if isinstance(each.default, float):
                # Compiled loops are of floats: 2 for 2.0 would be another type there.
                object.__setattr__(self, each.name, float(value))


def not_one_of(choices: Sequence[str], value: object) -> str:
    """Say that a value is none of the choices, and which of them is near."""
    # Late: nearly all values are right.
    from difflib import get_close_matches

    near = get_close_matches(str(value).lower(), choices, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    return f"expected one of {', '.join(choices)}, got {quoted(value)}{hint}"


def describe(metadata: Any) -> str:
    """Return the description of a setting with its unit and bounds, in one line."""
    bounds = [f"{words} {metadata[key]:g}" for key, words, _ in _BOUNDS if metadata[key] is not None]
    unit = [metadata["unit"]] if metadata["unit"] and metadata["unit"].upper() != metadata["unit"] else []
    choices = [" | ".join(metadata["choices"])] if metadata["choices"] else []
    notes = ", ".join(unit + bounds + choices)
    return f"{metadata['text']} [{notes}]" if notes else str(metadata["text"])


def described_fields(config_type: type[Any]) -> Iterator[Field[Any]]:
    """Yield the fields of a configuration that were made by `setting`."""
    return (each for each in fields(config_type) if each.metadata)


def subsections(config_type: type[Any]) -> dict[str, type[Any]]:
    """Return the configurations that are fields of a configuration, by the fields' names."""
    made: dict[str, Any] = {each.name: each.default_factory for each in fields(config_type)}
    return {name: each for name, each in made.items() if isinstance(each, type) and is_dataclass(each)}


def setting_paths(config_type: type[Any]) -> Iterator[tuple[str, Field[Any]]]:
    """Yield every setting of a configuration and its sections, with its path (``extended.cuts``)."""
    for each in described_fields(config_type):
        yield each.name, each
    for name, section in subsections(config_type).items():
        for path, each in setting_paths(section):
            yield f"{name}.{path}", each


def changed_paths(config: Any) -> list[str]:
    """Return the paths of the settings of a configuration that are not at their defaults."""
    return [
        path
        for path, each in setting_paths(type(config))
        if operator.attrgetter(path)(config) != each.default
    ]


def updated(config: Any, /, **changes: Any) -> Any:
    """Return a configuration with other values, those of a section as a mapping.

    An example: ``updated(config, ratio_max=0.9, extended={"cuts": 1})``. Raises ValueError if a value is out
    of its bounds, and TypeError if there is no such field.
    """
    return replace(
        config,
        **{
            name: updated(getattr(config, name), **value) if isinstance(value, Mapping) else value
            for name, value in changes.items()
        },
    )


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by path (``extended.cuts``) as `updated` takes them: those of a section as a mapping."""
    result: dict[str, Any] = {}
    for path, value in values.items():
        *sections, name = path.split(".")
        target = result
        for section in sections:
            target = target.setdefault(section, {})
        target[name] = value
    return result


@dataclass(frozen=True, slots=True)
class ValueKind:
    """What a setting's type annotation allows: bool, int, float or str, for the value or each of its numbers.

    It may be left unset (None) where `optional`. `length` is how many numbers it holds, 0 for a single value;
    `word` is what may stand in place of a number.
    """

    kind: type
    optional: bool = False
    length: int = 0
    word: str = ""

    def from_text(self, text: str) -> Any:
        """Return the value that a text stands for; raises ValueError where it is of another kind."""
        if self.kind is bool:
            if text.lower() not in _SWITCH:
                raise ValueError(f"expected 0 or 1, got {text!r}")
            return _SWITCH[text.lower()]
        if self.kind is str and self.optional and not text:
            # Mostly a variable of a script that is not set: a path would be the working folder.
            raise ValueError("expected a value, got ''")
        # Without a word of its own, an empty text is none either.
        if self.kind is str or (self.word and text == self.word):
            return text
        try:
            numbers = [self.kind(part) for part in (text.split(",") if self.length else [text])]
        except ValueError:
            numbers = []
        if len(numbers) != max(self.length, 1):
            raise ValueError(f"expected {self.words}, got {quoted(text)}")
        return self.from_toml(numbers if self.length else numbers[0])

    def from_toml(self, value: Any) -> Any:
        """Return the value of what a TOML or JSON file holds; raises ValueError if it is of another kind."""
        if value is None and self.optional:
            return None
        if self.length:
            if not isinstance(value, list) or len(value) != self.length:
                raise ValueError(f"expected {self.words}, got {quoted(value)}")
            return tuple(ValueKind(self.kind).from_toml(each) for each in value)
        if self.word and value == self.word:
            return value
        whole = isinstance(value, int) and not isinstance(value, bool)
        if self.kind is float and (whole or isinstance(value, float)):
            try:
                number = float(value)
            except OverflowError:
                raise ValueError(f"expected {self.words} of a float's range, got {quoted(value)}") from None
            if not math.isfinite(number):
                raise ValueError(f"expected a finite number, got {value}")
            return number
        if whole if self.kind is int else isinstance(value, self.kind):
            return value
        raise ValueError(f"expected {self.words}, got {quoted(value)}")

    @property
    def words(self) -> str:
        """What is expected, for a message."""
        names = {bool: "true or false", int: "a whole number", float: "a number", str: "a text in quotes"}
        either = f" or {self.word}" if self.word else ""
        numbers = f"{self.length} {'whole ' if self.kind is int else ''}numbers, separated by commas"
        return numbers if self.length else names[self.kind] + either


def value_kinds(section: type[Any]) -> dict[str, ValueKind]:
    """Return the kind of each field of a section.

    Raises TypeError if a field's annotation is none that a flag and a TOML value can express.
    """
    hints = get_type_hints(section)
    return {
        each.name: _kind_of(hints[each.name])
        for each in fields(section)
        if each.name not in subsections(section)
    }


def value_kind(config_type: type[Any], path: str) -> ValueKind:
    """Return the kind of the setting at a path (``extended.cuts``)."""
    *inner, name = path.split(".")
    for section in inner:
        config_type = subsections(config_type)[section]
    return value_kinds(config_type)[name]


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


def check_ip_address(name: str, text: str) -> None:
    """Raise ValueError, naming the field, if a text is no IP address."""
    try:
        ip_address(text)
    except ValueError:
        raise ValueError(f"{name}: expected an IP address such as 127.0.0.1, got {text!r}") from None
