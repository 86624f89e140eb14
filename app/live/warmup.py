"""Warm-up: loads compiled functions while the source and the view are being opened."""

import logging
import threading

import numpy as np

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation.config import SegmentationConfig

_log = logging.getLogger(__name__)

#: Size of the frames, pixels, and their number: one segmented independently, and two that continue it.
_WIDTH, _HEIGHT, _FRAMES = 160, 120, 3
#: Longest wait, seconds: loading takes half a second, compiling half a minute.
_WAIT_S = 120.0


class WarmUp:
    """Segments a few small artificial frames on a thread, which loads most compiled functions.

    Otherwise the first frame of a camera would take half a second longer, and the frames meanwhile be lost.
    With `draws`, what measures and draws their objects is loaded, too.
    """

    def __init__(self, config: SegmentationConfig, *, temporal: bool, draws: bool = True) -> None:
        self._config = config
        self._temporal = temporal
        self._draws = draws
        # A daemon, so that a run that cannot start does not wait for it.
        self._thread = threading.Thread(target=self._run, name="warm-up", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Wait until everything is loaded, two minutes at most; a signal can end the wait."""
        self._thread.join(_WAIT_S)

    def _run(self) -> None:
        try:
            segmenter = Segmenter(self._config, temporal=self._temporal)
            for index in range(_FRAMES if self._temporal else 1):
                result = segmenter.process(_frame(index))
                if self._draws:
                    from nurbseg.app.view.drawing.drawing import drawn

                    drawn(result, ViewConfig(), self._config.metric)
            if self._draws:
                from nurbseg.library.boxes.completion import vertical_axes

                # Nothing stands on a level plane in these frames.
                ends = np.ones((2, 3))
                vertical_axes(ends, np.arange(3), np.array([0.0, 1.0, 0.0]), ends[:, 2], ends[:, 2], 0.0)
        except Exception:
            # The run's own frames will fail with a clearer message.
            _log.debug("the warm-up failed", exc_info=True)


def _frame(index: int) -> RGBDFrame:
    """Return a frame of folded walls and a moving cone, with noise and holes, that exercises every step."""
    rows, columns = np.mgrid[:_HEIGHT, :_WIDTH]
    x, y = columns / _WIDTH - 0.5, rows / _HEIGHT - 0.6
    from_tip = np.hypot(x - 0.2 - 0.02 * index, y)
    cone = from_tip < 0.15
    depth_mm = 600.0 + 1500.0 * np.abs(x) + 300.0 * np.abs(y)
    depth_mm[cone] = 400.0 + 800.0 * from_tip[cone]
    depth_mm += (7 * rows + 13 * columns) % 3
    depth_mm[(31 * rows + 17 * columns) % 397 == 0] = 0.0
    depth_mm[:, :4] = 0.0
    color = np.stack([60 + 120 * (x > 0), 60 + 120 * (y > 0), np.full_like(rows, 128)], axis=-1)
    color[cone] = (210, 120, 40)
    camera = Intrinsics(_WIDTH, _HEIGHT, 131.0, 131.0, 79.5, 59.5)
    return RGBDFrame(
        index=index,
        timestamp_ns=index * 33_333_333,
        depth_mm=depth_mm.astype(np.uint16),
        color=color.astype(np.uint8),
        calibration=Calibration.registered(camera),
    )
