"""Settings that describe themselves: a dataclass field with its meaning, unit, bounds and symbol.

The command line, the configuration file and the checks are all made from these descriptions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import Field, field, fields
from typing import Any


def setting(
    default: Any,
    text: str,
    *,
    unit: str = "",
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] = (),
    symbol: str = "",
    flag: str = "",
) -> Any:
    """Describe one field of a configuration.

    Parameters
    ----------
    default : object
        Value where the user sets none.
    text, unit : str
        What it means, for a person, and in which unit. A unit in capitals (``FILE``) is a placeholder:
        it stands for what is to be given, in the help only.
    least, most, above : float, optional
        Smallest and largest value allowed; `above` is allowed for neither.
    choices : tuple of str
        The words allowed, where there is a list of them.
    symbol : str
        The literature's name of it, a second name for the flag.
    flag : str
        The flag's name where it is not the field's (``duration`` for ``duration_s``).
    """
    return field(
        default=default,
        metadata={
            "text": text,
            "unit": unit,
            "least": least,
            "most": most,
            "above": above,
            "choices": choices,
            "symbol": symbol,
            "flag": flag,
        },
    )


def check_settings(config: Any) -> None:
    """Hold every described field of a configuration against its bounds.

    Raises
    ------
    ValueError
        If a value is out of bounds; names the field, the value and what is expected.
    """
    for each in fields(config):
        bounds = each.metadata
        if not bounds:
            continue
        value = getattr(config, each.name)
        if value is None and each.default is not None:
            raise ValueError(f"{each.name}: expected a value, got None")
        if bounds["choices"] and value not in bounds["choices"]:
            raise ValueError(f"{each.name}: expected one of {', '.join(bounds['choices'])}, got {value!r}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            continue
        if bounds["least"] is not None and not value >= bounds["least"]:
            raise ValueError(f"{each.name}: expected at least {bounds['least']}, got {value}")
        if bounds["most"] is not None and not value <= bounds["most"]:
            raise ValueError(f"{each.name}: expected at most {bounds['most']}, got {value}")
        if bounds["above"] is not None and not value > bounds["above"]:
            raise ValueError(f"{each.name}: expected more than {bounds['above']}, got {value}")
        if not math.isfinite(value):
            raise ValueError(f"{each.name}: expected a finite number, got {value}")


def described_fields(config_type: type[Any]) -> Iterator[Field[Any]]:
    """Yield the fields of a configuration that were made by `setting`."""
    return (each for each in fields(config_type) if each.metadata)
