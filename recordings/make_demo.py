"""Makes ``demo.mcap``, the recording that is replayed when there is no camera.

Run it in the project's folder: ``python recordings/make_demo.py``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.synthetic.source import SyntheticOptions, SyntheticSource

#: One turn of the scene, so that a loop has no jump; as large as 5 MB of lossless depth allow.
DEMO = SyntheticOptions(frames=48, width=400, height=300, fps=12.0, seed=0)


def make_demo(path: Path, options: SyntheticOptions = DEMO) -> None:
    """Render the scene and write it as a recording.

    Parameters
    ----------
    path : Path
        The file; one that exists is replaced.
    options : SyntheticOptions
        What to render.
    """
    with SyntheticSource(options) as source:
        metadata = {**source.metadata, "labels": ", ".join(f"{n} {s}" for n, s in source.label_names.items())}
        with RecordingWriter(path, source.calibration, metadata=metadata) as writer:
            for frame in source:
                writer.write(frame)


def main() -> None:
    """Write the recording beside this file, or where the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "demo.mcap", help="the file to write"
    )
    make_demo(parser.parse_args().out)


if __name__ == "__main__":
    main()
