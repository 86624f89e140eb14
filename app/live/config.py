"""What a user may ask of live segmentation, where each frame continues the one before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from nurbseg.app.live.control.console import Control
from nurbseg.drivers.settings import Settings, setting

Temporal = Literal["auto", "on", "off"]


@dataclass(frozen=True, slots=True)
class LiveConfig(Settings):
    """Settings of live segmentation."""

    temporal: Temporal = setting(
        "auto",
        "whether a frame continues the one before it, so that segments keep their labels: on, off, or on for "
        "all but replays of every frame (--speed 0)",
        choices=get_args(Temporal),
    )
    target_fps: float = setting(
        30.0,
        "frames per second that live segmentation holds by doing less for each; 0 never does less",
        unit="1/s",
        least=0.0,
    )
    age_max_ms: float = setting(
        100.0,
        "age, when its labels are ready, beyond which a live frame is not shown, nor saved for viewing; "
        "0 shows every one",
        unit="ms",
        least=0.0,
    )

    control: Control = setting(
        "auto",
        "commands while it runs: keys where it runs in a terminal (auto), lines of standard input, or off",
        choices=get_args(Control),
    )

    def follows(self, *, every_frame: bool) -> bool:
        """Say whether frames continue each other in a run of every frame, or of the newest ones."""
        return self.temporal == "on" or (self.temporal == "auto" and not every_frame)
