"""Counts the product's files that have a function called for one live frame, from capture to view.

It runs the installed command, which replays a recording in real time, records it and saves the view, and
watches all of its processes::

    python benchmarks/frame_files.py scene.mcap

A file counts if a function of it is called, by whatever thread, from one frame to the next for at least every
second frame after the first ones; the number behind it says for what share of them. What is done between
frames, such as the progress line, counts too. Every frame is shown, also a late one; on a slow or busy
computer more of them are shown in full, with boxes and meshes. Compiled functions are called without Python,
and count only by the function around them. In a recording of a few frames, beginning again counts as well.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from functools import cache
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

COMMAND = Path(sys.executable).with_name("nurbseg-live")
PROJECT = Path(__file__).resolve().parent.parent
_PRODUCT = ("app/", "common/", "drivers/", "library/", "segmentation/")
#: Names the folder in which each process writes what it called.
_FOLDER = "FRAME_FILES"
#: Where a frame begins in a process: where it is segmented, and where it is shown.
_BEGINS = ("Segmenter.process", "RerunView.show")
#: Frames until everything has been called for the first time.
_FIRST = 10


def main() -> None:
    """Print the files by process, and how many different ones there are."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", help="what nurbseg-live replays")
    parser.add_argument("--duration", type=float, default=40.0, help="seconds to run (40)")
    parser.add_argument("options", nargs="*", help="further options of nurbseg-live, after --")
    given = parser.parse_intermixed_args()
    different: set[str] = set()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # Python imports it first of all, in each process.
        (folder / "sitecustomize.py").write_text("import frame_files\n\nframe_files.watch()\n")
        environment = os.environ | {
            "PYTHONPATH": f"{folder}:{Path(__file__).resolve().parent}",
            _FOLDER: name,
        }
        words = ["--replay", given.source, "--loop", "--duration", str(given.duration)]
        words += ["--view", "none", "--set", "age_max_ms=0"]
        words += ["--save", str(folder / "run.rrd"), "--record", str(folder / "run.mcap"), *given.options]
        subprocess.run([COMMAND, *words], env=environment, check=True)
        for path in sorted(folder.glob("*.json")):
            frames, called = json.loads(path.read_text())
            shares = {name: number / frames for name, number in sorted(called.items())}
            usual = [name for name, share in shares.items() if share >= 0.5]
            different.update(usual)
            print(f"\n{path.stem}: {len(usual)} files in {frames} frames, {len(shares)} in any")
            print(*(f"  {name} {share:.2f}" for name, share in shares.items()), sep="\n")
    print(f"\n{len(different)} different files")


def watch() -> None:
    """Count in this process for how many frames each file has a function called."""
    # The module that it runs, or the name of the command.
    modules = [word for word in sys.orig_argv if word.startswith("nurbseg.")]
    name = modules[0] if modules else Path(sys.orig_argv[-1 if len(sys.orig_argv) < 2 else 1]).name
    path = Path(os.environ[_FOLDER], f"{name}-{os.getpid()}.json")
    codes: set[CodeType] = set()
    called = Counter[str]()
    frames = -_FIRST

    def begin() -> None:
        nonlocal frames, codes
        # What other threads call meanwhile belongs to the next frame.
        done, codes = codes, set()
        if frames >= 0:
            called.update({file for file in map(product_file, done) if file})
        frames += 1
        if frames > 0:
            path.write_text(json.dumps([frames, called]))

    if sys.version_info >= (3, 12):
        tool, events = sys.monitoring.PROFILER_ID, sys.monitoring.events

        def start(code: CodeType, offset: int) -> Any:
            if code.co_qualname in _BEGINS:
                begin()
                sys.monitoring.restart_events()
            codes.add(code)
            return sys.monitoring.DISABLE

        sys.monitoring.use_tool_id(tool, "frame_files")
        for event in (events.PY_START, events.PY_RESUME):
            sys.monitoring.register_callback(tool, event, start)
        sys.monitoring.set_events(tool, events.PY_START | events.PY_RESUME)
    else:

        def profile(frame: FrameType, event: str, argument: Any) -> None:
            if event == "call":
                if frame.f_code.co_qualname in _BEGINS:
                    begin()
                codes.add(frame.f_code)

        threading.setprofile(profile)
        sys.setprofile(profile)


@cache
def product_file(code: CodeType) -> str:
    """Return the file of a function by its path in the project, or an empty text if it is none of ours."""
    path = Path(code.co_filename).resolve()
    name = str(path.relative_to(PROJECT)) if path.is_relative_to(PROJECT) else ""
    return name if name.startswith(_PRODUCT) else ""


if __name__ == "__main__":
    main()
