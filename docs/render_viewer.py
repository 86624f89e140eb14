"""Draw a Rerun recording as the viewer shows it, to a PNG, on a computer without a screen.

Needs a Vulkan driver; Debian's mesa-vulkan-drivers draws without a graphics card.

Usage: python docs/render_viewer.py RECORDING.rrd PICTURE.png [--frame N] [--view NAME] [--wait SECONDS]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import cv2
from rerun.experimental import ViewerClient

from nurbseg.app.view.config import ViewConfig
from nurbseg.app.view.viewer import free_port, listens, start_viewer

_HOST = "127.0.0.1"
#: Rows of the menu bar at the top, which says more of this computer than of the recording.
_MENU_ROWS = 36


def render(recording: Path, picture: Path, *, frame: int | None, view: str, wait_s: float) -> list[str]:
    """Draw a recording.

    Parameters
    ----------
    recording : Path
        The .rrd file.
    picture : Path
        The PNG to write.
    frame : int or None
        Which frame; the last one by default.
    view : str
        Name of the one view to draw; everything if empty.
    wait_s : float
        Time for the viewer to load and to lay out, seconds.

    Returns
    -------
    list of str
        What the viewer complains of.

    Raises
    ------
    ValueError
        If there is no view of that name.
    RuntimeError
        If the viewer does not start.
    """
    port = free_port(_HOST)
    process = start_viewer(ViewConfig(), port, headless=True)
    try:
        deadline_s = time.monotonic() + 30.0
        while not listens(_HOST, port):
            if process.poll() is not None or time.monotonic() > deadline_s:
                raise RuntimeError("the viewer does not start; is a Vulkan driver installed?")
            time.sleep(0.1)
        viewer = ViewerClient.connect(f"rerun+http://{_HOST}:{port}/proxy")
        viewer.open(str(recording.resolve()))
        time.sleep(wait_s)
        if frame is not None:
            viewer.set_time("frame", sequence=frame, play_state="paused")
            time.sleep(1.0)
        state = viewer.get_state()
        chosen = [each.view_id for each in state.views if each.name == view]
        if view and not chosen:
            names = ", ".join(sorted({each.name for each in state.views}))
            raise ValueError(f"no view is called {view!r}; there are {names}")
        viewer.save_screenshot(str(picture.resolve()), view_id=chosen[0] if chosen else None)
        return [f"{each.name}: {report}" for each in state.views for report in each.reports]
    finally:
        process.kill()
        process.wait()


def main() -> int:
    """Run the command; return 1 if the viewer complains of a view."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, help="the .rrd file")
    parser.add_argument("picture", type=Path, help="the PNG to write")
    parser.add_argument("--frame", type=int, help="which frame (default: the last)")
    parser.add_argument("--view", default="", help="draw the view of this name only")
    parser.add_argument(
        "--wait", type=float, default=5.0, metavar="SECONDS", help="time to load (default: 5)"
    )
    options = parser.parse_args()
    complaints = render(
        options.recording, options.picture, frame=options.frame, view=options.view, wait_s=options.wait
    )
    if not options.view:
        cv2.imwrite(str(options.picture), cv2.imread(str(options.picture))[_MENU_ROWS:])
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
