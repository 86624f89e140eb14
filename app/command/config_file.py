"""Reads and writes the configuration file: TOML with a table for each section."""

import json
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

from nurbseg.app.settings.app_config import AppConfig
from nurbseg.common.limits import TEXT_BYTES_MAX
from nurbseg.common.settings import describe, setting_paths, updated

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
    try:
        config: AppConfig = updated(AppConfig(), **tables)
    except ValueError as err:
        raise ConfigError(f"{path}: {err}") from err
    return config


def format_config(config: AppConfig) -> str:
    """Return a configuration as a complete TOML file."""
    lines = [_HEAD]
    for section, settings in groupby(setting_paths(AppConfig), lambda each: each[0].rpartition(".")[0]):
        lines.append(f"[{section}]")
        for path, field in settings:
            value = attrgetter(path)(config)
            lines.append(f"# {describe(field)}")
            lines.append(f"#{field.name} =" if value is None else f"{field.name} = {_toml(value)}")
        lines.append("")
    return "\n".join(lines)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML's escapes are JSON's, but DEL must be escaped, too.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(list(value) if isinstance(value, tuple) else value)
