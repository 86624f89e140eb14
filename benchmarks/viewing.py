"""Times what showing a frame costs, and how much of a file it fills, by the processor time of one thread.

Run it in the project's folder: ``python benchmarks/viewing.py SOURCE --frames 100``. *draw* is done in the
process of the run, *entities* and *log* in the view's. Every eighth frame is shown in full, with boxes and
meshes, which is more than in a live run at 30 frames/s.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from itertools import islice
from pathlib import Path
from statistics import median

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.entities import FrameEntities
from nurbseg.app.view.stream import FileSink, Opening
from nurbseg.common.computer import computer
from nurbseg.drivers.registry import open_source
from nurbseg.library.segmenter import Segmenter

_IN_FULL_EVERY = 8
#: The first frames load and compile.
_FIRST = 10
_CLOSE_S = 30.0


def main() -> None:
    """Print one line for each stage, and the size of a frame in the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", help="a recording")
    parser.add_argument("--frames", type=int, default=100, help="how many are shown (100)")
    options = parser.parse_args()
    view, segmenter = ViewConfig(), Segmenter()
    times: dict[str, list[float]] = {"draw": [], "entities": [], "log": []}
    with tempfile.TemporaryDirectory() as folder, open_source(options.source) as source:
        path = Path(folder) / "frames.rrd"
        sink = FileSink(path, Opening("benchmark", "", {}, ()))
        number = 0
        for number, frame in enumerate(islice(source, options.frames), start=1):
            result = segmenter.process(frame)
            start_s = time.thread_time()
            shown = drawn(result, view, "mse", in_full=number % _IN_FULL_EVERY == 0)
            drawn_s = time.thread_time()
            item = FrameEntities(shown, view)
            _ = item.entities
            made_s = time.thread_time()
            sink.put(item)
            if number > _FIRST:
                for name, took_s in zip(
                    times, (drawn_s - start_s, made_s - drawn_s, time.thread_time() - made_s), strict=True
                ):
                    times[name].append(1e3 * took_s)
        sink.close(_CLOSE_S)
        size = path.stat().st_size / max(number, 1)
    print(computer())
    for name, each_ms in times.items():
        print(f"{name:<9} {median(each_ms):5.1f} ms, mean {sum(each_ms) / len(each_ms):5.1f} ms")
    print(f"file      {size / 1e6:5.2f} MB a frame")


if __name__ == "__main__":
    main()
