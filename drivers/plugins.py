"""Opens sources that other packages register by the entry point group ``nurbseg.sources``.

The name of an entry point is the scheme of the URIs that it opens, ``name:rest``; its object is called with
`rest` and a `SourceOptions`, and returns an open `FrameSource`. A package is imported when such a URI is
opened, and whatever is wrong with it becomes an error that names it.
"""

import logging
from collections import defaultdict
from dataclasses import replace
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import numpy as np

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import (
    BackendMissingError,
    DeviceLostError,
    DriverError,
    FrameFormatError,
    RecordingFormatError,
)
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FrameSource, Wrapped

_log = logging.getLogger(__name__)

GROUP = "nurbseg.sources"
_REASON_CHARACTERS = 200


def registered_schemes() -> dict[str, list[EntryPoint]]:
    """Return what installed packages register, by scheme; raises DriverError if they cannot be listed."""
    found: dict[str, list[EntryPoint]] = defaultdict(list)
    try:
        for entry in entry_points(group=GROUP):
            found[entry.name].append(entry)
    # The metadata of any installed package may be damaged.
    except Exception as err:
        raise DriverError(f"the installed packages cannot be listed ({_reason(err)})") from err
    return dict(found)


def open_registered(entries: list[EntryPoint], rest: str, options: SourceOptions) -> FrameSource:
    """Open ``scheme:rest`` by the package that registers the scheme.

    Raises DriverError, which names the package, if it cannot be imported, fails or returns no source, or if
    several register the scheme; BackendMissingError if it lacks a library.
    """
    if len(entries) > 1:
        names = ", ".join(sorted(_package(entry) for entry in entries))
        raise DriverError(f"{entries[0].name}: is registered by {names}; uninstall all but one")
    (entry,) = entries
    name = f"{entry.name} (package {_package(entry)})"
    source: Any = None
    try:
        source = entry.load()(rest, options)
        if not isinstance(source, FrameSource):
            raise DriverError(f"{name}: returned {type(source).__name__} in place of a FrameSource")
        with closed_on_error(partial(_end, source, name)):
            source.is_open()
            if not isinstance(source.calibration, Calibration):
                raise DriverError(f"{name}: calibration: is {type(source.calibration).__name__}")
            return _Guarded(source, name)
    except DriverError:
        raise
    except ImportError as err:
        raise BackendMissingError(f"{name}: cannot be imported ({_reason(err)})") from err
    # A module that calls exit() when it is imported is broken, too.
    except (Exception, SystemExit) as err:
        raise DriverError(f"{name}: cannot be opened ({_reason(err)})") from err


class _Guarded(Wrapped):
    """A source of another package, all of whose errors are those of a source."""

    def __init__(self, source: FrameSource, name: str) -> None:
        super().__init__(source)
        self.live, self._name = source.live, name

    def skip(self, frames: int) -> int:
        """Skip frames as the source does."""
        return int(self._answer(self._source.skip, frames))

    def _read(self, timeout_s: float) -> RGBDFrame:
        frame = self._answer(self._source.read, timeout_s)
        self.labels_fault = self._source.labels_fault
        if not isinstance(frame, RGBDFrame):
            raise FrameFormatError(f"{self._name}: returned {type(frame).__name__} in place of a frame")
        # Plain arrays, whatever mapped or masked ones it has: they go to another process.
        return replace(frame, depth_mm=np.array(frame.depth_mm), color=np.array(frame.color))

    def _seek(self, index: int) -> None:
        self._answer(self._source.seek, index)

    def _close(self) -> None:
        _end(self._source, self._name)

    def _answer(self, call: Any, argument: float) -> Any:
        try:
            return call(argument)
        except DriverError:
            raise
        except Exception as err:
            kind = DeviceLostError if self.live else RecordingFormatError
            raise kind(f"{self._name}: failed ({_reason(err)})") from err


def _end(source: FrameSource, name: str) -> None:
    """Close a source; the frames are there, so what goes wrong now is only logged."""
    try:
        source.close()
    except Exception as err:
        _log.warning("%s: cannot be closed (%s)", name, _reason(err))


def _package(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else entry.value


def _reason(err: BaseException) -> str:
    """Return an error on one line."""
    text = " ".join(f"{type(err).__name__}: {err}".split())
    return text if len(text) <= _REASON_CHARACTERS else f"{text[:_REASON_CHARACTERS]}..."
