"""The configuration of a run, made of sections.

A section's fields are its keys in the configuration file and its flags on the command line. A new setting is
a new field; a new section is a new dataclass and a new field of `AppConfig`.
"""

import logging
from collections.abc import Collection
from dataclasses import Field, dataclass, field
from typing import Any, Literal
from urllib.parse import urlencode

from nurbseg.app.settings.output_config import (
    ExplainConfig,
    ExportConfig,
    PublishConfig,
    RecordConfig,
    ViewConfig,
)
from nurbseg.common.settings import Settings, setting
from nurbseg.drivers.options import ASSOCIATION_LIMIT_S, SOURCE_MEMORY_MB, DeviceOptions
from nurbseg.segmentation.config import TRIALS_MAX, DepthConfig, SegmentationConfig

_log = logging.getLogger("nurbseg.config")

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

    paused: bool = setting(False, "whether to begin paused at the first frame")
    control: Control = setting(
        "auto",
        "commands while it runs: keys if it runs in a terminal (auto), lines of standard input, or off",
    )

    def follows(self, *, every_frame: bool) -> bool:
        """Whether frames continue each other in a run with --speed 0, or another one."""
        return self.temporal == "on" or (self.temporal == "auto" and not every_frame)


@dataclass(frozen=True, slots=True)
class SourceConfig(Settings):
    """Settings of the source of frames.

    Raises ValueError if more than one source is named, or a value is out of bounds.
    """

    device: str | None = setting(
        None,
        "camera to open: xtion, kinect, orbbec, any, realsense, a serial number, or the URI of OpenNI2 or "
        "another package",
        unit="NAME",
    )
    replay: str | None = setting(None, "recording or folder of images to replay", unit="PATH")
    color_images: str | None = setting(
        None,
        "color images to replay, with any names: a pattern in quotes; needs --depth",
        unit="GLOB",
        flag="color",
    )
    depth_images: str | None = setting(
        None, "their depth images, paired by the text that the wildcards match", unit="GLOB", flag="depth"
    )
    fallback: str | None = setting(None, "what to replay if no camera is found", unit="PATH")
    speed: float | None = setting(
        None,
        "replay speed: 1 as recorded, dropping late frames; 0 as fast as possible, segmenting every frame; "
        "without it, exports and saved views are of every frame, at most as fast as recorded if there is a "
        "viewer, and anything else is as with 1",
        least=0.0,
    )
    workers: int | Literal["auto"] = setting(
        1,
        "processes that segment the frames of a replay with --speed 0 independently; auto: one per core",
        least=1,
    )
    loop: bool = setting(False, "restart a replay at its end")
    start: int = setting(0, "frames to skip at the start of a replay", least=0)
    frames: int | None = setting(None, "stop after this many frames", least=1)
    duration_s: float | None = setting(
        None, "stop after this long, by the frames' timestamps", unit="s", above=0.0, flag="duration"
    )
    intrinsics: tuple[float, float, float, float] | None = setting(
        None,
        "focal lengths and principal point, in pixels, for images without calibration",
        unit="FX,FY,CX,CY",
    )
    depth_scale: float | None = setting(
        None, "depth units per meter, for images that do not specify them", unit="1/m", above=0.0
    )
    depth_topic: str | None = setting(
        None, "topic of the depth images of an MCAP recording, if not the one chosen", unit="TOPIC"
    )
    color_topic: str | None = setting(None, "topic of its color images", unit="TOPIC")
    association_limit_s: float = setting(
        ASSOCIATION_LIMIT_S,
        "maximum time difference between a depth image and its color image",
        unit="s",
        above=0.0,
    )

    source_memory_mb: int = setting(
        SOURCE_MEMORY_MB,
        "what the process that reads the source may take, for a damaged file to take no more",
        unit="MB",
        least=500,
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if len(self.named) > 1:
            raise ValueError(f"{', '.join(self.named)}: name one source, not {len(self.named)}")
        if (self.color_images is None) != (self.depth_images is None):
            missing = "depth_images" if self.depth_images is None else "color_images"
            raise ValueError(f"{missing}: expected a pattern; color and depth images must be given together")
        if self.intrinsics is not None and (self.intrinsics[0] <= 0 or self.intrinsics[1] == 0):
            raise ValueError(f"intrinsics: expected focal lengths in pixels, got {self.intrinsics[:2]}")

    @property
    def named(self) -> tuple[str, ...]:
        """The kinds of source that the user named."""
        return tuple(name for name in SOURCE_KINDS if getattr(self, name))

    @property
    def replayed(self) -> str | None:
        """The recording to replay; None for a camera."""
        if self.color_images is not None and self.depth_images is not None:
            patterns = {"color": self.color_images, "depth": self.depth_images}
            return f"images:?{urlencode(patterns, safe='*?/[]')}"
        return self.replay


#: The fields of `SourceConfig` of which at most one is given.
SOURCE_KINDS = ("device", "replay", "color_images")


@dataclass(frozen=True, slots=True)
class AppConfig:
    """The configuration of a run."""

    source: SourceConfig = field(default_factory=SourceConfig)
    camera: DeviceOptions = field(default_factory=DeviceOptions)
    depth: DepthConfig = field(default_factory=DepthConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    live: LiveConfig = field(default_factory=LiveConfig)
    view: ViewConfig = field(default_factory=ViewConfig)
    explain: ExplainConfig = field(default_factory=ExplainConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)

    @property
    def shown(self) -> ViewConfig:
        """The view, which is none if frames are only recorded."""
        return ViewConfig(mode="none") if self.record.only else self.view

    @property
    def keeps_results(self) -> bool:
        """Whether results of frames are to be in files."""
        return self.shown.save is not None or (self.export.directory is not None and not self.record.only)

    @property
    def every_frame(self) -> bool:
        """Whether each frame of a replay is segmented, however long that takes."""
        return self.source.speed == 0 or (self.source.speed is None and self.keeps_results)


#: Settings that only an experiment changes: keys of the configuration and of --set, without a flag.
_EXPERIMENTAL = """
samples landmarks cut_points affinity_scale splitting_point large_error_m large_curvature_per_m
control_points_max control_points least_squares noise_floor noise_correlation_px inverse_depth_gap
cuts color_weight normal_weight normal_window_px knot_spacing_px smoothness fold_surfaces
split_creases protrusion_min refine_borders merge_surfaces log_odds_min save_index memory_limit
layout jpeg_quality points_max mesh_step_px residual_max_m space_min_mb trials_max age_max_ms
association_limit_s source_memory_mb silence_limit_s reconnect_interval_s
"""
WITHOUT_FLAG = frozenset(_EXPERIMENTAL.split())


def flags(each: Field[Any]) -> list[str]:
    """Return how a setting is given: the names of its flag, the usual one first, or ``--set NAME``."""
    if each.name in WITHOUT_FLAG:
        return [f"--set {each.name}"]
    names = [each.metadata["flag"] or each.name.replace("_", "-")]
    if each.metadata["symbol"]:
        names.append(each.metadata["symbol"])
    return [f"--{name}" for name in names]


def warn_of_unread(paths: Collection[str], methods: Collection[str]) -> None:
    """Warn of settings of the segmentation, by path, that none of the methods reads."""
    for section, readers in (("stag15", ("stag15", "pz14")), ("extended", ("nurbseg",))):
        names = [path.rpartition(".")[2] for path in paths if path.startswith(f"{section}.")]
        if names and not set(readers) & set(methods):
            unread, chosen = ", ".join(names), ", ".join(methods)
            _log.warning("%s: no effect with %s, only with the method %s", unread, chosen, readers[0])
