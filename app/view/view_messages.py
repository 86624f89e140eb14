"""Messages between a run and the process that shows and saves its frames.

A run also sends each `ViewFrame` and `RunState`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.frame import Moment
from nurbseg.segmentation.config import SegmentationConfig


@dataclass(frozen=True, slots=True)
class Open:
    """Open the viewer and the file; `properties` are stored with the recording, by subject."""

    config: ViewConfig
    segmentation: SegmentationConfig
    properties: Mapping[str, Mapping[str, str]]
    name: str
    log_level: int


@dataclass(frozen=True, slots=True)
class Line:
    """A log line to show, and its level."""

    moment: Moment
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class Asked:
    """A command that somebody gave on the page; `number` counts them from 1."""

    command: str
    number: int


@dataclass(frozen=True, slots=True)
class Close:
    """End; the file must be complete within so many seconds."""

    file_limit_s: float


@dataclass(frozen=True, slots=True)
class State:
    """State of the process, which sends it after opening and whenever it has changed."""

    viewer_hint: str = ""
    serving: bool = False
    #: Frames that were not shown live, and connections to a viewer so far.
    dropped: int = 0
    connections: int = 0
    #: The first thing that could not be opened, shown or saved; empty if there is none.
    problem: str = ""
    #: Whether everything was shown and saved.
    closed: bool = False
