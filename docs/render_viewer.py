"""Draw a Rerun recording as the viewer shows it, to a PNG or a WebP, on a computer without a screen.

Needs a Vulkan driver; Debian's mesa-vulkan-drivers draws without a graphics card.

Usage: python docs/render_viewer.py RECORDING.rrd PICTURE.png [--frame N] [--view NAME] [--size WxH]
       python docs/render_viewer.py RECORDING.rrd FILE.webp --frames FIRST,LAST,STEP [--fps N] [--width PX]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
from PIL import Image
from rerun.experimental import ViewerClient

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.viewer import free_port, listens, start_viewer

_HOST = "127.0.0.1"
#: Rows of the menu bar at the top, which says more of this computer than of the recording.
_MENU_ROWS = 36
_NO_VIEWER = "the viewer does not start; is a Vulkan driver installed?"
#: Time to lay out tabs that were opened, seconds.
_LAYOUT_S = 1.5


@contextmanager
def opened(recording: Path, wait_s: float, size: str) -> Iterator[ViewerClient]:
    """Open a recording in a viewer without a window; `wait_s` seconds are left to it to load and to lay out.

    Raises
    ------
    RuntimeError
        If the viewer does not start, or shows nothing of the recording.
    """
    port = free_port(_HOST)
    words = ["--window-size", size] if size else []
    process = start_viewer(ViewConfig(), port, "--headless", *words)
    try:
        deadline_s = time.monotonic() + 30.0
        while not listens(_HOST, port):
            if process.poll() is not None or time.monotonic() > deadline_s:
                raise RuntimeError(_NO_VIEWER)
            time.sleep(0.1)
        try:
            viewer = ViewerClient.connect(f"rerun+http://{_HOST}:{port}/proxy")
            viewer.open(str(recording.resolve()))
        except ConnectionError:
            # Without a driver it listens for a moment.
            raise RuntimeError(_NO_VIEWER) from None
        time.sleep(wait_s)
        if not viewer.get_state().views:
            raise RuntimeError(
                f"{recording}: the viewer shows nothing of it; is it complete, or --wait too short?"
            )
        yield viewer
    finally:
        process.kill()
        process.wait()


def draw(viewer: ViewerClient, picture: Path, *, frame: int | None, view: str) -> list[str]:
    """Draw a frame, the last one where it is None, or one view of it; return what the viewer complains of.

    Raises
    ------
    ValueError
        If there is no view of that name.
    """
    if frame is not None:
        viewer.set_time("frame", sequence=frame, play_state="paused")
        time.sleep(1.0)
    state = viewer.get_state()
    chosen = [each.view_id for each in state.views if each.name == view]
    if view and not chosen:
        names = ", ".join(sorted({each.name for each in state.views}))
        raise ValueError(f"no view is called {view!r}; there are {names}")
    if chosen:
        _bring_to_front(viewer, chosen[0])
    viewer.save_screenshot(str(picture.resolve()), view_id=chosen[0] if chosen else None)
    if not view:
        cv2.imwrite(str(picture), cv2.imread(str(picture))[_MENU_ROWS:])
    return [f"{each.name}: {report}" for each in state.views for report in each.reports]


def _bring_to_front(viewer: ViewerClient, view_id: str) -> None:
    """Open the tabs that a view is in, since hidden ones are not drawn."""
    layout, inner, opened_any = viewer.get_blueprint().blueprint, f"/view/{view_id}", False
    holders = {
        child: path
        for path, content in layout.items()
        if path.startswith("/container/")
        for child in content["ContainerBlueprint"]["contents"]
    }
    while inner in holders:
        outer = layout[holders[inner]]["ContainerBlueprint"]
        if outer["container_kind"] == "Tabs" and outer.get("active_tab") != inner:
            outer["active_tab"], opened_any = inner, True
        inner = holders[inner]
    if opened_any:
        viewer.set_blueprint(layout, of="recording")
        time.sleep(_LAYOUT_S)


def animate(
    viewer: ViewerClient, path: Path, frames: range, *, fps: float, width: int, view: str
) -> list[str]:
    """Draw frames one by one, `width` pixels wide, and write them as an animation that repeats."""
    images, complaints = [], []
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "frame.png"
        for frame in frames:
            complaints += draw(viewer, picture, frame=frame, view=view)
            with Image.open(picture) as image:
                height = round(image.height * width / image.width)
                images.append(image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS))
    first, *others = images
    first.save(
        path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0, quality=60, method=6
    )
    return complaints


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
    parser.add_argument("--size", default="", metavar="WxH", help="the viewer's size, such as 1280x800")
    parser.add_argument("--frames", metavar="FIRST,LAST,STEP", help="write an animation of these frames")
    parser.add_argument("--fps", type=float, default=6.0, help="frames a second of an animation (default: 6)")
    parser.add_argument("--width", type=int, default=960, help="width of an animation, pixels (default: 960)")
    options = parser.parse_args()
    if not options.recording.is_file():
        parser.exit(2, f"{parser.prog}: error: {options.recording}: no such file\n")
    with opened(options.recording, options.wait, options.size) as viewer:
        if options.frames is None:
            complaints = draw(viewer, options.picture, frame=options.frame, view=options.view)
        else:
            first, last, step = map(int, options.frames.split(","))
            complaints = animate(
                viewer,
                options.picture,
                range(first, last + 1, step),
                fps=options.fps,
                width=options.width,
                view=options.view,
            )
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
