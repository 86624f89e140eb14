"""The source that renders: a scene with exact ground truth, as a depth camera would deliver it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.depth import millimeters
from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.common.settings import Settings, described_fields, from_text, setting
from nurbseg.drivers.datasets.sequence import SequenceSource
from scene.render import Renderer, Rendering
from scene.scene import TICKS_PER_S, RenderedScene
from scene.sensor import SensorModel

LabelKind = Literal["objects", "surfaces"]
#: Focal lengths of a camera 640 pixels wide: of the registered pair and color, and of infrared.
_COLOR_FOCAL_PX, _DEPTH_FOCAL_PX = 525.0, 572.0
#: Place of the depth camera seen from the color camera, meters, and its turn, radians about x, y, z.
_OFFSET_M, _TURN = (-0.025, 0.0006, -0.0012), (0.004, -0.006, 0.003)
_COLOR_DISTORTION = (0.11, -0.24, 0.0008, -0.0011, 0.06)
_DEPTH_DISTORTION = (-0.06, 0.14, -0.0007, 0.0009, -0.05)


@dataclass(frozen=True, slots=True)
class SyntheticOptions(Settings):
    """What to render; as text, ``key=value&...``."""

    frames: int = setting(120, "length of the sequence", unit="frames", least=1)
    width: int = setting(640, "width of the depth image", unit="px", least=16, most=4096)
    height: int = setting(480, "height of the depth image", unit="px", least=16, most=4096)
    color_width: int = setting(
        0, "width of the color image, 0 for the depth's", unit="px", least=0, most=4096
    )
    color_height: int = setting(
        0, "height of the color image, 0 for the depth's", unit="px", least=0, most=4096
    )
    fps: float = setting(30.0, "frame rate; the scene moves by its own clock", unit="1/s", above=0.0)
    seed: int = setting(0, "seed of positions, textures and noise", least=0)
    noise: bool = setting(True, "the sensor's artifacts (noise, steps, shadows, edges, range)")
    offset: bool = setting(False, "separate cameras: depth is not registered to color")
    distortion: bool = setting(False, "lens distortion of both cameras (needs offset=1)")
    labels: LabelKind = setting(
        "objects",
        "what each label stands for: an object, or one of its faces",
    )
    hide: int = setting(
        0, "frames during which the ball is hidden behind the carton", unit="frames", least=0, most=60
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.distortion and not self.offset:
            raise ValueError("distortion: expected offset=1 with it, since registered images have none")
        if (self.color_width > 0) != (self.color_height > 0):
            raise ValueError("color_width, color_height: expected both or neither")
        if self.color_width and not self.offset:
            raise ValueError("color_width: expected offset=1 with it, since registered images have one size")

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Read ``key=value&...``, which may be empty.

        Raises ValueError if a key is unknown or a value does not fit; names the key and what is expected.
        """
        known = {each.name: each for each in described_fields(cls)}
        chosen: dict[str, Any] = {}
        for key, value in parse_qsl(text, keep_blank_values=True, strict_parsing=bool(text)):
            if key not in known:
                raise ValueError(f"{key}: unknown; expected one of {', '.join(known)}")
            if key in chosen:
                raise ValueError(f"{key}: given twice")
            chosen[key] = from_text(known[key], value)
        return cls(**chosen)


class SyntheticSource(SequenceSource):
    """Frames of a rendered scene; the same options give the same frames."""

    def __init__(self, options: SyntheticOptions | None = None) -> None:
        self.options = options or SyntheticOptions()
        super().__init__(Path("scene"), self.options.frames, "rendered")
        self.calibration = _calibration(self.options)
        self.metadata = {"name": "synthetic scene", "seed": str(self.options.seed)}
        self._scene = RenderedScene(
            self.options.seed, round(self.options.hide * TICKS_PER_S / self.options.fps)
        )
        self._depth = Renderer(self._scene, self.calibration.depth)
        self._color = Renderer(self._scene, self.calibration.color) if self.options.offset else None
        self._sensor = SensorModel(self.calibration.depth, self.options.seed) if self.options.noise else None
        #: Of each object's faces.
        self._first_label = np.cumsum([1, *(each.shape.faces for each in self._scene.objects)])

    @property
    def label_names(self) -> dict[int, str]:
        """What each ground-truth label stands for."""
        if self.options.labels == "objects":
            return {n + 1: name for n, name in enumerate(self._scene.names)}
        return {
            int(self._first_label[n]) + face: f"{name} {face}" if each.shape.faces > 1 else name
            for n, (name, each) in enumerate(zip(self._scene.names, self._scene.objects, strict=True))
            for face in range(each.shape.faces)
        }

    def corners_m(self, label: int) -> NDArray[np.float64]:
        """Return the corners, (N, 3) meters, of an object in its own frame, by its label of an object."""
        return np.asarray(self._scene.objects[label - 1].shape.corners_m)

    def poses(self, index: int) -> tuple[NDArray[np.float64], dict[int, NDArray[np.float64]]]:
        """Return the exact poses of the depth camera and of every object at a frame, (4, 4) in meters.

        They lead to the scene's frame. Objects go by their labels in ``labels=objects``, whatever labels the
        frames carry.
        """
        tick = self._tick(index)
        objects = range(len(self._scene.objects))
        return self._scene.world_from_depth(tick), {
            n + 1: self._scene.world_from_object(n, tick) for n in objects
        }

    def _tick(self, index: int) -> float:
        return index * TICKS_PER_S / self.options.fps

    def _load(self, index: int) -> RGBDFrame:
        tick = self._tick(index)
        world_from_depth = self._scene.world_from_depth(tick)
        seen = self._depth.render(world_from_depth, tick)
        if self._color is None:
            color = self._depth.color(world_from_depth, tick, seen)
        else:
            world_from_color = world_from_depth @ np.linalg.inv(self.calibration.color_from_depth)
            color = self._color.color(world_from_color, tick, self._color.render(world_from_color, tick))
        return RGBDFrame(
            index=index,
            timestamp_ns=round(index * 1e9 / self.options.fps),
            depth_mm=(
                millimeters(seen.depth_m, units_per_meter=1.0)
                if self._sensor is None
                else self._sensor.measure(seen.depth_m, index)
            ),
            color=color,
            calibration=self.calibration,
            labels=self._labels(seen),
            name=f"synthetic-{index:06d}",
        )

    def _labels(self, seen: Rendering) -> NDArray[np.uint16]:
        if self.options.labels == "objects":
            return seen.objects.astype(np.uint16)
        first = np.concatenate([[0], self._first_label]).astype(np.uint16)
        return np.asarray(first[seen.objects] + seen.faces, dtype=np.uint16)


def _calibration(options: SyntheticOptions) -> Calibration:
    width, height = options.width, options.height

    def camera(width: int, height: int, focal_px: float, distortion: tuple[float, ...]) -> Intrinsics:
        focal = focal_px * width / 640
        center = (width - 1) / 2, (height - 1) / 2
        coefficients = np.array(distortion if options.distortion else ())
        return Intrinsics(width, height, focal, focal, *center, distortion=coefficients)

    if not options.offset:
        return Calibration.registered(camera(width, height, _COLOR_FOCAL_PX, ()))
    color_from_depth = np.eye(4)
    rx, ry, rz = _TURN
    skew = np.array([[0, -rz, ry], [rz, 0, -rx], [-ry, rx, 0]])
    # Cayley's formula makes an exact rotation of three small angles.
    color_from_depth[:3, :3] = np.linalg.solve(np.eye(3) - skew / 2, np.eye(3) + skew / 2)
    color_from_depth[:3, 3] = _OFFSET_M
    return Calibration(
        depth=camera(width, height, _DEPTH_FOCAL_PX, _DEPTH_DISTORTION),
        color=camera(
            options.color_width or width, options.color_height or height, _COLOR_FOCAL_PX, _COLOR_DISTORTION
        ),
        color_from_depth=color_from_depth,
    )
