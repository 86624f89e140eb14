"""Settings of recordings."""

import time
from dataclasses import dataclass
from typing import Literal

from nurbseg.common.settings import Settings, setting

RecordColor = Literal["jpeg95", "png", "raw"]


def dated(name: str) -> str:
    """Replace ``{date}`` in a file name by the current date and time."""
    return name.replace("{date}", time.strftime("%Y%m%d-%H%M%S"))


@dataclass(frozen=True, slots=True)
class RecordConfig(Settings):
    """Settings of the recording that is made during a run.

    Raises ValueError if a value is out of bounds, or the file's name does not end in .mcap.
    """

    file: str | None = setting(
        None,
        "record the frames while they are segmented, as .mcap; {date} in the name, as for --save, becomes "
        "the date and time",
        unit="FILE",
        flag="record",
    )
    only: bool = setting(False, "record without segmenting or showing", flag="record-only")
    delay_s: float = setting(
        0.0,
        "start recording this long after the first frame; --frames and --duration count from there",
        unit="s",
        least=0.0,
        flag="record-delay",
    )
    split_s: float | None = setting(
        None,
        "start a new file (NAME-2.mcap, NAME-3.mcap ...) at this interval",
        unit="s",
        least=1.0,
        flag="record-split",
    )
    color: RecordColor = setting(
        "jpeg95",
        "encoding of color: JPEG of quality 95, or lossless PNG or raw",
        flag="record-color",
    )
    space_min_mb: int = setting(
        200,
        "stop recording, with a readable file, when less disk space is left",
        unit="MB",
        least=1,
        flag="record-space-min",
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.file is not None and not self.file.lower().endswith(".mcap"):
            known = " (.oni recordings are replayed, but no longer made)" * self.file.lower().endswith(".oni")
            raise ValueError(f"file: expected a name that ends in .mcap, got {self.file!r}{known}")
        for name in ("only", "delay_s", "split_s"):
            if getattr(self, name) and self.file is None:
                raise ValueError(f"{name}: expected a file to record to as well (--record FILE)")
