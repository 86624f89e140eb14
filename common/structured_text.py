"""Parses untrusted TOML, YAML and XML, whose size the caller has limited.

Neither recursion nor references can make a small text large: YAML has no aliases here, XML no document type.
Every fault is a ValueError with a short message; the caller names the file.
"""

import codecs
import tomllib
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import yaml

from nurbseg.common.errors import quoted
from nurbseg.common.limits import TEXT_BYTES_MAX, TEXT_DEPTH_MAX, TEXT_VALUES_MAX
from nurbseg.common.settings import number

#: A longer line is no setting; the parser takes time with the square of a key's parts.
_TOML_LINE_MAX = 4096
_NUMBER_CHARACTERS_MAX = 64
_YAML_NULLS = ("", "~", "null")
_YAML_NUMBERS = {".nan": float("nan"), ".inf": float("inf"), "+.inf": float("inf"), "-.inf": float("-inf")}


def decode_text(content: bytes, errors: str = "strict") -> str:
    """Return a text, which is UTF-8 unless its byte order mark says otherwise, without this mark.

    Raises UnicodeDecodeError, a ValueError, unless `errors` says otherwise, as for ``bytes.decode``.
    """
    # Windows programs write UTF-16, and PowerShell's ">" does.
    is_utf_16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if is_utf_16 else "utf-8-sig", errors)


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text; raises ValueError if it is not TOML, or exceeds the limits."""
    if any(len(line) > _TOML_LINE_MAX for line in text.splitlines()):
        raise ValueError(f"expected lines of {_TOML_LINE_MAX} characters at most")
    if len(text) > TEXT_BYTES_MAX:
        raise ValueError(f"expected {TEXT_BYTES_MAX} characters at most, got {len(text)}")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except ValueError as err:
        raise ValueError(_one_line(err)) from err


def parse_yaml(text: str) -> Any:
    """Return the first document of a YAML text: dicts, lists, numbers, texts and None.

    Tags are passed over. Scalars that read as numbers are numbers, all others are texts. Raises ValueError if
    it is not YAML, has aliases, or exceeds the limits.
    """
    loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    values = depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            if isinstance(event, yaml.DocumentEndEvent):
                break
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("aliases (*name) are not allowed")
            values += isinstance(event, yaml.NodeEvent)
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if values > TEXT_VALUES_MAX or depth > TEXT_DEPTH_MAX:
                raise ValueError(
                    f"expected {TEXT_VALUES_MAX} values at most, nested {TEXT_DEPTH_MAX} deep at most"
                )
        return _with_numbers(next(yaml.load_all(text, Loader=loader), None))
    except yaml.YAMLError as err:
        raise ValueError(_one_line(err)) from err


def _with_numbers(value: Any) -> Any:
    """Return a value with its texts replaced by the numbers that they stand for."""
    if isinstance(value, dict):
        return {key: _with_numbers(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_with_numbers(each) for each in value]
    return None if value is None else scalar(value)


def scalar(text: str) -> int | float | str | None:
    """Return the number that a plain scalar stands for, else its text; None where it is null."""
    if text.lower() in _YAML_NULLS:
        return None
    value = number(text) if len(text) <= _NUMBER_CHARACTERS_MAX else text
    return _YAML_NUMBERS.get(text.lower(), value)


def parse_xml(text: str) -> Element:
    """Return the root of an XML text, which may be nested to any depth.

    Raises ValueError if it is not XML, has a document type, or exceeds the limits.
    """
    if "<!DOCTYPE" in text:
        raise ValueError("a document type (<!DOCTYPE) is not allowed")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as err:
        raise ValueError(_one_line(err)) from err


def _one_line(err: Exception) -> str:
    return quoted(" ".join(str(err).split()))[1:-1]
