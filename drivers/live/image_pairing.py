"""Pairs the depth and color images of a camera, as they come, by the device's time."""

from typing import Generic, Protocol, TypeVar


class Timed(Protocol):
    """An image and the device's time, microseconds."""

    @property
    def timestamp_us(self) -> int:
        """When it was taken."""


Image = TypeVar("Image", bound=Timed)

#: Images of a stream that wait for their other halves: of two rates, the slower one's may come much later.
_WAITING_MAX = 3


class ImagePairing(Generic[Image]):
    """Pairs images whose times differ by `limit_us` at most; `dropped` counts those whose half never came."""

    def __init__(self, limit_us: int) -> None:
        self.dropped = 0
        self._limit_us = limit_us
        self._waiting: dict[bool, list[Image]] = {True: [], False: []}

    def clear(self) -> None:
        """Forget the images that wait, without counting them."""
        for images in self._waiting.values():
            images.clear()

    def add(self, image: Image, *, is_depth: bool) -> tuple[Image, Image] | None:
        """Add an image; return the pair of depth and color that it completes, if any."""
        waiting, others = self._waiting[is_depth], self._waiting[not is_depth]
        gaps_us = [abs(each.timestamp_us - image.timestamp_us) for each in others]
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
