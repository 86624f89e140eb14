"""Opens what a run publishes its results to."""

import logging
from collections.abc import Callable
from pathlib import Path

from nurbseg.app.publish.lines import SocketLines, StandardOutput
from nurbseg.app.publish.publisher import Publisher, Sink
from nurbseg.app.settings.output_config import FOXGLOVE_PORT, PublishConfig
from nurbseg.segmentation.config import SegmentationConfig

_log = logging.getLogger(__name__)


def open_publisher(
    config: PublishConfig,
    segmentation: SegmentationConfig,
    *,
    every: bool,
    ask: Callable[[str], object] = lambda _: None,
) -> Publisher:
    """Return a publisher of every result, or of the newest.

    `ask` is given what listeners ask of the run, such as ``ratio 0.9``, in threads of theirs.
    Raises PublishError if a library is missing or an address or a file cannot be used.
    """
    sinks: list[Sink] = []
    try:
        for kind, target in config.publications:
            if kind == "foxglove":
                from nurbseg.app.publish.foxglove import FoxgloveServer

                server = FoxgloveServer(config.bind, int(target or FOXGLOVE_PORT), segmentation, ask)
                sinks.append(server)
                _log.info("Foxglove: open %s", server.address)
            elif target:
                sinks.append(SocketLines(Path(target)))
                _log.info("results: a line of JSON per frame on the Unix socket %s", target)
            else:
                sinks.append(StandardOutput())
    except BaseException:
        for sink in sinks:
            sink.close()
        raise
    return Publisher(sinks, every=every)
