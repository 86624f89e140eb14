"""Reads and writes the configuration file: TOML with a table for each section."""

import difflib
import json
from operator import attrgetter
from pathlib import Path
from typing import Any

from nurbseg.app.settings.app_config import AppConfig, sections
from nurbseg.common.errors import quoted
from nurbseg.common.limits import TEXT_BYTES_MAX
from nurbseg.common.settings import describe, described_fields, subsections, value_kinds

_HEAD = """\
# Configuration of nurbseg-live: `nurbseg-live --config FILE` reads it, flags come after it.
# A key behind "#" is not set; take the "#" away to set it.
"""


class ConfigError(ValueError):
    """A configuration is invalid; the message names the file, the key and what is expected."""


def read_config(path: Path) -> AppConfig:
    """Read a configuration file, which may contain some sections and keys of `AppConfig` only.

    Raises ConfigError if the file cannot be read, or a section, key or value is invalid.
    """
    # Late, so that --help does not wait for the parsers.
    from nurbseg.common.structured_text import decode_text, parse_toml

    try:
        with path.open("rb") as file:
            # A pipe may be given as well, and a device has no end.
            tables = parse_toml(decode_text(file.read(TEXT_BYTES_MAX + 1)))
    except OSError as err:
        raise ConfigError(f"{path}: cannot be read: {err.strerror}") from err
    except ValueError as err:
        raise ConfigError(f"{path}: is not TOML: {err}") from err
    known = subsections(AppConfig)
    values: dict[str, Any] = {}
    for name, table in tables.items():
        if name not in known or not isinstance(table, dict):
            raise ConfigError(f"{path}: unknown {_unknown(name, table)}")
        values[name] = read_section(path, name, known[name], table)
    return AppConfig(**values)


def read_section(path: Path, name: str, section: type[Any], table: dict[str, Any]) -> Any:
    """Read a section of a file, or one within it.

    Raises ConfigError, which names the file, the section and the key, if a key or value is invalid.
    """
    kinds, inner = value_kinds(section), subsections(section)
    values = {}
    for key, value in table.items():
        if key in inner and isinstance(value, dict):
            values[key] = read_section(path, f"{name}.{key}", inner[key], value)
            continue
        if key not in kinds:
            raise ConfigError(f"{path}: unknown key {_short(f'{name}.{key}')}{_nearest(f'{name}.{key}')}")
        try:
            values[key] = kinds[key].from_toml(value)
        except ValueError as err:
            raise ConfigError(f"{path}: {name}.{key}: {err}") from err
    try:
        return section(**values)
    except ValueError as err:
        raise ConfigError(f"{path}: {name}.{err}") from err


def assigned(text: str) -> tuple[str, Any]:
    """Return the path and the value of a setting from ``NAME=VALUE``, its name with or without the section.

    Raises ValueError if there is no such setting, or the value is invalid.
    """
    name, equals, value = text.partition("=")
    wanted = name.strip().replace("-", "_")
    found = [
        f"{section}.{field.name}"
        for section, config_type in sections().items()
        for field in described_fields(config_type)
        if wanted in (f"{section}.{field.name}", field.name, field.metadata["symbol"])
    ]
    if not equals or len(found) != 1:
        fault = "no such setting" if not found else f"expected one of {', '.join(found)}"
        fault = fault if equals else "expected NAME=VALUE"
        raise ValueError(f"--set {text}: {fault}{'' if found else _nearest(wanted)}")
    section, _, key = found[0].rpartition(".")
    try:
        return found[0], value_kinds(sections()[section])[key].from_text(value)
    except ValueError as err:
        raise ValueError(f"--set {text}: {err}") from err


def _short(key: str) -> str:
    return quoted(key)[1:-1]


def _unknown(name: str, table: object) -> str:
    if isinstance(table, dict):
        return (
            f"section [{_short(name)}]: expected one of {', '.join(f'[{section}]' for section in sections())}"
        )
    return f"key {_short(name)}: keys must be in a section{_nearest(name)}"


def _nearest(key: str) -> str:
    """Return " (did you mean ...?)" with the valid key most similar to a wrong one, or an empty text."""
    valid: dict[str, str] = {}
    for name, section in sections().items():
        for field in described_fields(section):
            full = f"{name}.{field.name}"
            # A key may be in the wrong section, or a symbol of the literature.
            for spelling in (full, field.name, field.metadata["symbol"], field.metadata["flag"]):
                valid.setdefault(spelling, full)
    valid.pop("", None)
    bare = key.rpartition(".")[2]
    for wanted in (bare, key):
        close = difflib.get_close_matches(wanted, valid, n=1, cutoff=0.7)
        if close:
            return f" (did you mean {valid[close[0]]}?)"
    return ""


def format_config(config: AppConfig) -> str:
    """Return a configuration as a complete TOML file."""
    lines = [_HEAD]
    for name, section in sections().items():
        lines.append(f"[{name}]")
        values = attrgetter(name)(config)
        for field in described_fields(section):
            value = getattr(values, field.name)
            lines.append(f"# {describe(field.metadata)}")
            lines.append(f"#{field.name} =" if value is None else f"{field.name} = {_toml(value)}")
        lines.append("")
    return "\n".join(lines)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML's escapes are JSON's, but DEL must be escaped, too.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(each) for each in value)}]"
    return repr(value)
