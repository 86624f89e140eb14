"""A camera whose depth and color images come one by one, and are paired by the device's time."""

import time
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

from numpy.typing import NDArray

from nurbseg.common.errors import DeviceLostError, FrameFormatError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.options import DeviceOptions
from nurbseg.drivers.source import FrameSource

#: Longest single wait for an image, seconds: how late an unplugged camera is noticed.
_SLICE_S = 0.1
#: Images of a stream that wait for their other halves: of two rates, the slower one's may come much later.
_WAITING_MAX = 3


class Image(NamedTuple):
    """A copy of one image: its device time in microseconds, its number, and its pixels."""

    timestamp_us: int
    number: int
    pixels: NDArray[Any]


class ImagePairing:
    """Pairs images whose times differ by `limit_us` at most; `dropped` counts those whose half never came."""

    def __init__(self, limit_us: int) -> None:
        self.dropped = 0
        self._limit_us = limit_us
        self._waiting: dict[bool, list[Image]] = {True: [], False: []}

    def add(self, image: Image, *, is_depth: bool) -> tuple[Image, Image] | None:
        """Add an image; return the pair of depth and color that it completes, if any."""
        waiting, others = self._waiting[is_depth], self._waiting[not is_depth]
        gaps_us = [abs(other.timestamp_us - image.timestamp_us) for other in others]
        if not gaps_us or min(gaps_us) > self._limit_us:
            self.dropped += len(waiting) == _WAITING_MAX
            waiting[:] = [*waiting, image][-_WAITING_MAX:]
            return None
        nearest = gaps_us.index(min(gaps_us))
        other = others[nearest]
        # The other halves of older ones can no longer come.
        self.dropped += len(waiting) + nearest
        waiting.clear()
        del others[: nearest + 1]
        return (image, other) if is_depth else (other, image)


class PairedCamera(FrameSource):
    """Frames of a camera, each a depth image and the color image taken with it.

    Subclasses open the camera, take images in `_take_pair`, which gives them to `_add`, and make a frame of
    a pair in `_frame`. They set `_pairing` by `_pair_within`, and ``metadata`` has ``device`` and ``uri``.

    Frames are not queued: a late reader gets the newest. `missed` counts depth images that were never seen
    here, and `half_pairs` images whose other half never came.
    """

    live = True
    #: The camera may take this long to deliver its first frames, seconds.
    start_limit_s = 5.0

    def __init__(self, options: DeviceOptions | None) -> None:
        super().__init__()
        self.missed = self.half_pairs = 0
        self._options = options or DeviceOptions()
        self._index = 0
        self._last_number: int | None = None
        #: Pairs that are dropped, since they were taken before the settings were applied.
        self._settling = 0
        #: For how long no pair came, and what was wrong with the images that did.
        self._silent_s, self._problem = 0.0, ""

    @property
    def losses(self) -> Mapping[str, int]:
        """Depth images never seen here, and images whose other half never came."""
        return {"missed": self.missed, "half_pairs": self.half_pairs}

    @property
    @abstractmethod
    def _is_gone(self) -> bool:
        """Whether the camera was unplugged or has failed."""

    @abstractmethod
    def _take_pair(self, timeout_s: float) -> tuple[Image, Image] | None:
        """Wait for an image; return the depth and color that it completes, if any."""

    @abstractmethod
    def _frame(self, depth: Image, color: Image) -> RGBDFrame:
        """Make the frame of a pair, whose number is `_index`."""

    def _pair_within(self, limit_s: float, fps: int) -> None:
        """Pair images closer in time than this and than half a period of the faster stream."""
        self._pairing = ImagePairing(min(round(limit_s * 1e6), 1_000_000 // max(1, fps) // 2 + 1000))

    def _read(self, timeout_s: float) -> RGBDFrame:
        deadline = time.monotonic() + timeout_s
        while True:
            self._check_present()
            begun = time.monotonic()
            try:
                pair = self._take_pair(min(max(deadline - begun, 0.0), _SLICE_S))
            except FrameFormatError as err:
                # A camera that delivers no others counts as silent.
                self._silent_s += time.monotonic() - begun
                self._problem = f" ({err})"
                raise
            if pair is None:
                now = time.monotonic()
                self._silent_s += now - begun
                if now >= deadline:
                    self._check_present()
                    raise FrameTimeoutError(
                        f"{self.metadata['device']}: no depth and color within {timeout_s:g} s"
                    )
                continue
            self._silent_s, self._problem = 0.0, ""
            if self._settling == 0:
                frame = self._frame(*pair)
                self._index += 1
                return frame
            self._settling -= 1

    def _check_present(self) -> None:
        name = f"{self.metadata['device']} at {self.metadata['uri']}"
        if self._is_gone:
            raise DeviceLostError(f"{name} was unplugged or has failed")
        limit_s = self._options.silence_limit_s
        if self._index == 0:
            limit_s = max(limit_s, self.start_limit_s)
        if self._silent_s > limit_s:
            raise DeviceLostError(f"{name}: no depth and color for {limit_s:g} s{self._problem}")

    def _add(self, image: Image, *, is_depth: bool) -> tuple[Image, Image] | None:
        """Add an image; return the pair of depth and color that it completes, if any.

        Raises FrameFormatError if it is not of its camera's size.
        """
        if is_depth:
            if self._last_number is not None and not self._settling:
                self.missed += max(0, image.number - self._last_number - 1)
            self._last_number = image.number
        camera = self.calibration.depth if is_depth else self.calibration.color
        height, width = image.pixels.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise FrameFormatError(
                f"{'depth' if is_depth else 'color'} frame {image.number}: {width}x{height} pixels, expected "
                f"{camera.width}x{camera.height}"
            )
        before = self._pairing.dropped
        pair = self._pairing.add(image, is_depth=is_depth)
        self.half_pairs += self._pairing.dropped - before
        return pair
