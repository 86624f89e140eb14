"""The live view: a thread sends the newest frame to a viewer."""

import contextlib
import logging
import time
from collections.abc import Callable

import rerun as rr

from nurbseg.app.settings.output_config import viewer_address
from nurbseg.app.view.stream import NewestSink, Opening, Writer
from nurbseg.app.view.viewer import listens

logger = logging.getLogger(__name__)

#: Time limit of a flush, after which the viewer counts as stalled, seconds; not shorter, as each flush that
#: timed out stays in Rerun's queue.
_PATIENCE_S = 3.0
#: Pause between two attempts to reach a viewer.
_RETRY_S = 0.5


class ViewerSink(NewestSink):
    """Shows the newest frames in a viewer while there is one; the connection ends with the process.

    A frame is logged once the viewer has taken the previous one: otherwise Rerun would block in `log` while
    the viewer is frozen. `starting` says whether a viewer is being started, so that its absence is no news.
    """

    def __init__(self, url: str, opening: Opening, starting: Callable[[], bool] = lambda: False) -> None:
        self._url = url
        self._address = viewer_address(url)
        self._opening = opening
        self._starting = starting
        self._absence_logged = self._stall_logged = False
        super().__init__("view-live")

    def _run(self) -> None:
        try:
            while not self.queue.finished:
                if listens(*self._address):
                    if self._serve():
                        continue
                elif not self._may_come():
                    return
                time.sleep(_RETRY_S)
        except Exception:
            logger.exception("nothing more will be shown in the viewer at %s", self._url)

    def _may_come(self) -> bool:
        """Whether to keep waiting for a viewer that does not listen."""
        if self.connections:
            return not self.queue.closed
        if self._starting():
            return True
        if not self._absence_logged:
            self._absence_logged = True
            logger.warning("no viewer is listening at %s; it will be used as soon as one is", self._url)
        return not self.queue.closed

    def _serve(self) -> bool:
        """Send to one viewer until it is gone or all is sent; return whether it took anything."""
        stream = self._opening.stream()
        taken = False
        try:
            stream.set_sinks(rr.GrpcSink(self._url))
            self._opening.send(stream)
            taken = connected = self._taken(stream)
            if connected:
                logger.info("showing in the viewer at %s", self._url)
                self.connections += 1
            writer = Writer()
            while taken and not self.queue.finished:
                with contextlib.suppress(TimeoutError):
                    if (item := self.queue.take(1.0)) is not None:
                        writer.write(stream, item)
                taken = self._taken(stream)
            # While it starts or ends, it may listen for a moment without taking anything.
            if connected and not taken:
                logger.warning("the viewer at %s is gone; it will be used again if it comes back", self._url)
            return connected
        finally:
            stream.disconnect()

    def _taken(self, stream: rr.RecordingStream) -> bool:
        """Wait until the viewer's side took everything; return False if it is gone."""
        logged = False
        while True:
            try:
                stream.flush(timeout_sec=_PATIENCE_S)
            except RuntimeError as err:
                if "timed out" not in str(err):
                    return False
            else:
                if logged:
                    logger.info("the viewer at %s accepts frames again", self._url)
                return True
            # Once: a browser on a slow computer stalls again and again.
            if not self._stall_logged:
                logged = self._stall_logged = True
                logger.warning("the viewer at %s is not responding; frames are not shown for now", self._url)
