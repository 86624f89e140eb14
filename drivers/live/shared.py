"""A camera that several readers share: each has its newest frame, or every frame from a queue of its own."""

import threading
import time
from collections.abc import Callable, Mapping

from nurbseg.common.errors import DriverError, FrameFormatError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.common.process.bounded_queue import BoundedQueue
from nurbseg.drivers.source import FrameSource

#: Longest wait for a frame before the end is looked for again, seconds.
_SLICE_S = 0.1
#: Images that may wait for a reader of every frame, bytes: two seconds at 640x480, most of one at 1280x720.
_WAITING_BYTES = 100_000_000
#: Pause after a damaged frame, seconds: a source may fail at once each time.
_DAMAGED_S = 1e-3
#: Longest wait for a pending read when the camera is closed, seconds.
_END_S = 5.0


class CameraReader(FrameSource):
    """One reader of a `SharedCamera`.

    It takes part from its first `read` on. Closing it leaves the camera to the others.

    Attributes
    ----------
    missed : int
        Frames that the camera delivered since then, but that this reader did not take.
    """

    live = True

    def __init__(self, camera: "SharedCamera", *, every: bool) -> None:
        super().__init__()
        self.calibration, self.metadata = camera.calibration, camera.metadata
        self._camera = camera
        self._last: int | None = None
        self.queue: BoundedQueue[RGBDFrame | FrameFormatError] = (
            BoundedQueue(_WAITING_BYTES, "drop oldest", _size) if every else BoundedQueue(1, "drop oldest")
        )

    @property
    def losses(self) -> Mapping[str, int]:
        """Losses of the camera, and the frames that this reader did not take among the missed."""
        lost = self._camera.losses
        return {**lost, "missed": lost.get("missed", 0) + self.missed}

    def latest(self, max_age_ms: float) -> RGBDFrame:
        """Return the camera's newest frame, as `FrameSource.latest` says."""
        return self._camera.latest(max_age_ms)

    def reader(self, *, every: bool = False) -> "CameraReader":
        """Return one more reader of the camera."""
        return self._camera.reader(every=every)

    def _read(self, timeout_s: float) -> RGBDFrame:
        self._camera.join(self)
        try:
            item = self.queue.take(max(0.0, timeout_s))
        except TimeoutError as err:
            raise FrameTimeoutError(f"{self._camera.silence}: no frame within {timeout_s:g} s") from err
        if not isinstance(item, RGBDFrame):
            raise item or DriverError(f"{self._camera.silence} is closed")
        if self._last is not None:
            self.missed += item.index - self._last - 1
        self._last, self.calibration = item.index, item.calibration
        return item

    def _close(self) -> None:
        self._camera.leave(self)


class SharedCamera(FrameSource):
    """A camera, read by a thread of its own for any number of readers.

    `read` and iteration give the newest frame that was not read yet; frames in between are counted as
    `missed`, and their numbers left out. So a loop is never behind, however slow it is. `latest` gives the
    newest frame without waiting. `reader` returns further readers, which do not take frames from each other:
    with ``every=True`` one that gets every frame in its order, such as a recorder.

    The camera delivers from the first `read` or `latest` of anyone on. `source` is owned.
    """

    live = True

    def __init__(self, source: FrameSource, *, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self.calibration, self.metadata = source.calibration, source.metadata
        #: What is said of a camera that delivers nothing.
        self.silence = self._name = self.metadata.get("device", "the camera")
        self._source = source
        self._clock = clock
        self._changed = threading.Lock()
        #: All that are open, and those of them that have begun to read.
        self._readers: list[CameraReader] = []
        self._joined: list[CameraReader] = []
        self._newest: tuple[RGBDFrame, float] | None = None
        self._failure: BaseException | None = None
        self._stop = threading.Event()
        # A daemon: a program that forgets to close a camera still ends.
        self._thread = threading.Thread(target=self._deliver, name="camera", daemon=True)
        self._own = self.reader()

    @property
    def connected(self) -> bool:
        """Whether the camera is there; if not, it is waited for."""
        return bool(getattr(self._source, "connected", True)) and self._failure is None

    @property
    def losses(self) -> Mapping[str, int]:
        """What the camera lost before any reader could have it."""
        return self._source.losses

    def reader(self, *, every: bool = False) -> CameraReader:
        """Return one more reader of this camera, for a thread of its own; it is closed with the camera.

        With `every`, frames wait for it in their order; only of very many the oldest are missed.
        """
        reader = CameraReader(self, every=every)
        with self._changed:
            self._readers.append(reader)
        return reader

    def latest(self, max_age_ms: float) -> RGBDFrame:
        """Return the newest frame, as `FrameSource.latest` says."""
        if self._closed:
            raise DriverError(f"{type(self).__name__} is closed")
        self._begin()
        if self._failure is not None:
            raise self._failure
        newest = self._newest
        if newest is None:
            raise FrameTimeoutError(f"{self.silence}: no frame yet")
        frame, arrived_s = newest
        age_ms = 1e3 * (self._clock() - arrived_s)
        if age_ms > max_age_ms:
            raise FrameTimeoutError(
                f"{self.silence}: the newest frame came {age_ms:.0f} ms ago, over {max_age_ms:g} ms"
            )
        return frame

    def join(self, reader: CameraReader) -> None:
        """Have frames delivered to a reader, too."""
        with self._changed:
            if not any(reader is each for each in self._joined):
                self._joined.append(reader)
                if self._failure is not None:
                    reader.queue.close(self._failure)
        self._begin()

    def leave(self, reader: CameraReader) -> None:
        """Forget a reader."""
        with self._changed:
            for readers in (self._joined, self._readers):
                readers[:] = [each for each in readers if each is not reader]
        reader.queue.discard()

    def _begin(self) -> None:
        with self._changed:
            if self._thread.ident is None and not self._stop.is_set():
                self._thread.start()

    def _deliver(self) -> None:
        while not self._stop.is_set():
            try:
                item: RGBDFrame | FrameFormatError = self._source.read(_SLICE_S)
            except FrameTimeoutError as err:
                self.silence = str(err).partition(": no ")[0]
                continue
            except FrameFormatError as err:
                item = err
                self._stop.wait(_DAMAGED_S)
            except BaseException as err:
                # Each reader raises it.
                self._end(err)
                return
            if isinstance(item, RGBDFrame):
                self._newest, self.silence = (item, self._clock()), self._name
                self.calibration = item.calibration
            with self._changed:
                for reader in self._joined:
                    reader.queue.put(item)

    def _end(self, failure: BaseException) -> None:
        with self._changed:
            self._failure = failure
            for reader in self._joined:
                reader.queue.close(failure)

    def _read(self, timeout_s: float) -> RGBDFrame:
        frame = self._own.read(timeout_s)
        self.missed = self._own.missed
        return frame

    def _close(self) -> None:
        with self._changed:
            self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(_END_S)
        self._end(DriverError(f"{self._name} is closed"))
        for reader in tuple(self._readers):
            reader.close()
        self._source.close()


def _size(item: RGBDFrame | FrameFormatError) -> float:
    return item.depth_mm.nbytes + item.color.nbytes if isinstance(item, RGBDFrame) else 1
