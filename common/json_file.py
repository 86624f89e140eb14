"""JSON files, written completely or not at all, and read back."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nurbseg.common.files import read_file, write_atomically

#: Bytes of a JSON file: 16 MiB, a hundred times what a tree takes.
_JSON_BYTES_MAX = 1 << 24


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON file as `write_atomically` does."""
    write_atomically(path, (json.dumps(document, indent=1) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file, which anybody may have changed.

    Raises FileNotFoundError if there is none, and ValueError, which names the file, if it is not a regular
    file, too large, or contains no JSON object.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: does not exist")
    content = read_file(path, _JSON_BYTES_MAX, what="file")
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as err:
        raise ValueError(f"{path}: cannot be read: {err}") from err
    if not isinstance(document, dict):
        raise ValueError(f"{path}: cannot be read: expected a JSON object")
    return document
