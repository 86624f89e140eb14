"""Settings: dataclass fields that are described by a text, unit, bounds and symbol.

The command line, the configuration file and the checks are all made from these descriptions and the fields'
types.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import Field, field, fields, is_dataclass, replace
from operator import attrgetter, ge, gt, le
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from nurbseg.common.errors import listed, named, quoted

#: How a switch is written where flags have no word of their own for it.
_SWITCH = {"1": True, "true": True, "0": False, "false": False}
_BOUNDS = {"above": ("more than", gt), "least": ("at least", ge), "most": ("at most", le)}
#: A whole number may be too large for a float, too.
_FINITE = {"least": -sys.float_info.max, "most": sys.float_info.max}
_WORDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "a text in quotes"}


def setting(
    default: Any, text: str, *, unit: str = "", symbol: str = "", flag: str = "", **bounds: float
) -> Any:
    """Describe one field of a configuration.

    `text` says what it means. A `unit` in capitals (``FILE``) is a placeholder for the value, in the help
    only. `symbol` is its name in the literature, a second name for the flag; `flag` is the flag's name where
    it is not the field's (``duration`` for ``duration_s``). Of the `bounds`, the value is at `least` and at
    `most` such a number, and more than `above`.
    """
    notes = {"text": text, "unit": unit, "symbol": symbol, "flag": flag, "bounds": bounds}
    return field(default=default, metadata=notes)


class Settings:
    """A configuration of described fields and of sections; its dataclasses are frozen.

    Raises ValueError if a value is of another type or out of its bounds; names the field, the value and what
    is expected.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        for each in described_fields(type(self)):
            # Live frames change one setting: the others' defaults are right.
            if (value := getattr(self, each.name)) is not each.default:
                object.__setattr__(self, each.name, checked(each, value))


def checked(each: Field[Any], value: Any) -> Any:
    """Return the value of a setting in its type, as compiled loops need it: 2.0 for 2, a tuple for a list.

    Raises ValueError as `Settings` does.
    """
    from msgspec import convert  # late: --help needs no values

    with suppress(ValueError):
        # A number of NumPy counts as Python's.
        found = convert(value.item() if hasattr(value, "item") else value, each.type)
        parts = found if isinstance(found, tuple) else (found,)
        bounds = [(_BOUNDS[name][1], bound) for name, bound in (_FINITE | each.metadata["bounds"]).items()]
        numbers = [part for part in parts if isinstance(part, int | float)]
        if all(fits(part, bound) for part in numbers for fits, bound in bounds):
            return found
    if choices(each):
        raise ValueError(f"{each.name}: {not_one_of(choices(each), value)}")
    expected = ", ".join([" or ".join(map(_words, kinds(each))), *_bounds(each)])
    raise ValueError(f"{each.name}: expected {expected}, got {quoted(value)}")


def kinds(each: Field[Any]) -> tuple[Any, ...]:
    """Return the types that the value of a setting may have, besides that of None."""
    union = get_origin(each.type) in (Union, UnionType)
    return tuple(kind for kind in (get_args(each.type) if union else [each.type]) if kind is not NoneType)


def choices(each: Field[Any]) -> tuple[str, ...]:
    """Return the words that a setting may be; none if it may be anything else."""
    return get_args(kinds(each)[0]) if get_origin(kinds(each)[0]) is Literal else ()


def _words(kind: Any) -> str:
    inner = get_args(kind)
    if get_origin(kind) is tuple:
        return f"{len(inner)} {'whole ' * (inner[0] is int)}numbers, separated by commas"
    return ", ".join(inner) if inner else _WORDS[kind]


def _bounds(each: Field[Any]) -> list[str]:
    return [f"{_BOUNDS[name][0]} {bound:g}" for name, bound in each.metadata["bounds"].items()]


def not_one_of(choices: Sequence[str], value: object) -> str:
    """Say that a value is none of the choices, and which of them is near."""
    # Late: nearly all values are right.
    from difflib import get_close_matches

    near = get_close_matches(str(value).lower(), choices, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    return f"expected one of {', '.join(choices)}, got {quoted(value)}{hint}"


def describe(each: Field[Any]) -> str:
    """Return the description of a setting with its unit and bounds, in one line."""
    text, unit = each.metadata["text"], each.metadata["unit"]
    words = " | ".join(choices(each))
    notes = ", ".join(filter(None, [unit if unit.upper() != unit else "", *_bounds(each), words]))
    return f"{text} [{notes}]" if notes else str(text)


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


def setting_named(config_type: type[Any], name: str) -> tuple[str, Field[Any]]:
    """Return a setting, with its path, by this path, its name or its symbol (``lambda``).

    Raises ValueError unless there is one such setting.
    """
    wanted, every = name.strip().replace("-", "_"), dict(setting_paths(config_type))
    found = [path for path, each in every.items() if wanted in (path, each.name, each.metadata["symbol"])]
    if len(found) == 1:
        return found[0], every[found[0]]
    raise ValueError(f"{name}: expected one of {listed(found)}" if found else _unknown(config_type, wanted))


def _unknown(config_type: type[Any], wanted: str) -> str:
    """Say that there is no such setting, and which is near: it may be in another section."""
    from difflib import get_close_matches

    valid: dict[str, str] = {}
    for path, each in setting_paths(config_type):
        for spelling in (path, each.name, each.metadata["symbol"], each.metadata["flag"]):
            valid.setdefault(spelling, path)
    valid |= {path.rpartition(".")[0]: f"[{path.rpartition('.')[0]}]" for path in valid.values()}
    del valid[""]
    words = (wanted.rpartition(".")[2], wanted)
    near = [valid[each] for word in words for each in get_close_matches(word, valid, n=1, cutoff=0.7)]
    hint = f"did you mean {near[0]}?" if near else "nurbseg-live --print-config prints all"
    return f"{named(wanted)}: no such setting ({hint})"


def assigned(config_type: type[Any], text: str) -> tuple[str, Any]:
    """Return the path and the value of a setting from ``NAME=VALUE``.

    Raises ValueError if there is no such setting, or the value is invalid.
    """
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"{text}: expected NAME=VALUE")
    path, each = setting_named(config_type, name)
    return path, checked(each, from_text(each, value))


def from_text(each: Field[Any], text: str) -> Any:
    """Return what a text stands for as the value of a setting: a switch, numbers, or the text itself."""
    kind = kinds(each)[0]
    if kind is str:
        return text
    # Papers print the names of metrics in capitals.
    text = text.lower()
    if kind is bool:
        return _SWITCH.get(text, text)
    return [number(part) for part in text.split(",")] if get_origin(kind) is tuple else number(text)


def number(text: str) -> int | float | str:
    """Return the number that a text stands for, else the text itself."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def changed_paths(config: Any) -> list[str]:
    """Return the paths of the settings of a configuration that are not at their defaults."""
    return [path for path, each in setting_paths(type(config)) if attrgetter(path)(config) != each.default]


def updated(config: Any, /, **changes: Any) -> Any:
    """Return a configuration with other values, by path or those of a section as a mapping.

    An example: ``updated(config, ratio_max=0.9, extended={"cuts": 1})``. Raises ValueError, which names the
    path, if there is no such setting or a value is invalid.
    """
    values, every = dict(_flat(type(config), changes)), dict(setting_paths(type(config)))
    if unknown := [path for path in values if path not in every]:
        raise ValueError(_unknown(type(config), unknown[0]))
    return _replaced(config, values)


def _flat(config_type: type[Any], values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield values by path, those of a section that there is not as one: it may be nested to any depth."""
    sections = subsections(config_type)
    for name, value in values.items():
        if name in sections and isinstance(value, Mapping):
            yield from _flat(sections[name], value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _replaced(config: Any, values: Mapping[str, Any], prefix: str = "") -> Any:
    own = {each.name: prefix + each.name for each in described_fields(type(config))}
    changes = {name: values[path] for name, path in own.items() if path in values}
    for name in subsections(type(config)):
        changes[name] = _replaced(getattr(config, name), values, f"{prefix}{name}.")
    try:
        return replace(config, **changes)
    except ValueError as err:
        raise ValueError(f"{prefix}{err}") from err


def check_ip_address(name: str, text: str) -> None:
    """Raise ValueError, naming the field, if a text is no IP address."""
    from ipaddress import ip_address

    try:
        ip_address(text)
    except ValueError:
        raise ValueError(f"{name}: expected an IP address such as 127.0.0.1, got {text!r}") from None
