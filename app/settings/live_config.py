"""Settings of live segmentation, in which each frame continues the previous one."""

from dataclasses import dataclass
from typing import Literal

from nurbseg.common.settings import Settings, setting
from nurbseg.segmentation.config import TRIALS_MAX

Temporal = Literal["auto", "on", "off"]
Control = Literal["auto", "lines", "off"]


@dataclass(frozen=True, slots=True)
class LiveConfig(Settings):
    """Settings of live segmentation."""

    temporal: Temporal = setting(
        "auto",
        "whether a frame continues the previous one, so segments keep their labels: on, off, or auto (on, "
        "except when every frame is replayed with --speed 0)",
    )
    target_fps: float = setting(
        30.0,
        "frame rate that live segmentation maintains by doing less per frame; 0 to never do less",
        unit="1/s",
        least=0.0,
    )
    trials_max: int = setting(
        TRIALS_MAX,
        "leaves of the live tree that are cut in one frame to try a split, the worst first; others wait for "
        "the next frames; 0 for no limit, so that everything that has changed is tried at once",
        least=0,
    )
    age_max_ms: float = setting(
        100.0,
        "latency from capture to labels above which a live frame is neither shown nor saved for viewing; "
        "0 for no limit",
        unit="ms",
        least=0.0,
    )

    paused: bool = setting(False, "whether to begin paused at the first frame, to correct or to explain it")
    control: Control = setting(
        "auto",
        "commands while it runs: keys if it runs in a terminal (auto), lines of standard input, or off",
    )

    def follows(self, *, every_frame: bool) -> bool:
        """Whether frames continue each other in a run of every frame, or of the newest ones."""
        return self.temporal == "on" or (self.temporal == "auto" and not every_frame)
