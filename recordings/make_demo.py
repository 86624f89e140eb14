"""Makes ``demo.mcap``, the recording that is replayed when there is no camera, or one of another scene.

Run it in the project's folder: ``python recordings/make_demo.py``, or with ``--scene`` and the options of
`scene.source.SyntheticOptions`: ``--scene "seed=7&frames=60" --out seed7.mcap``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.options import ColorFormat
from scene.source import SyntheticOptions, SyntheticSource

#: One turn of the scene, so that a loop has no jump; as large as 5 MB of lossless depth allow.
DEMO = SyntheticOptions(frames=48, width=400, height=300, fps=12.0, seed=0)


def make_demo(path: Path, options: SyntheticOptions = DEMO, color_format: ColorFormat = "jpeg95") -> None:
    """Render the scene and write it as a recording.

    Parameters
    ----------
    path : Path
        The file; one that exists is replaced.
    options : SyntheticOptions
        What to render.
    color_format : {"jpeg95", "png"}
        How color is compressed: PNG loses nothing.
    """
    with SyntheticSource(options) as source:
        labels = ", ".join(f"{n} {s}" for n, s in source.label_names.items())
        metadata = {**source.metadata, "labels": labels}
        writer = RecordingWriter(path, source.calibration, color_format=color_format, metadata=metadata)
        with writer:
            for frame in source:
                writer.write(frame)


def main() -> None:
    """Write the recording beside this file, or what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "demo.mcap", help="the file to write"
    )
    parser.add_argument(
        "--scene",
        type=SyntheticOptions.from_text,
        metavar="KEY=VALUE&...",
        help="another scene, whose color is recorded without loss",
    )
    given = parser.parse_args()
    make_demo(given.out, given.scene or DEMO, "png" if given.scene else "jpeg95")


if __name__ == "__main__":
    main()
