"""Make the pictures of gallery.md, each by the command that stands there, from the demo recording.

Needs what ``pip install '.[eval]'`` brings, a Vulkan driver as render_viewer.py does, and Chromium.

Usage: python docs/render_gallery.py FOLDER
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import rerun as rr
from PIL import Image
from render_viewer import draw, opened

_RECORDING = Path(__file__).resolve().parent.parent / "recordings" / "demo.mcap"
#: The frame that is shown, and the step of it that is explained.
_FRAME, _STEP = 29, 4
_WIDTH_PX, _SIZE, _WAIT_S = 800, "1500x1050", 4.0
_VIEWS = {
    "scene": "Scene with boxes of objects",
    "objects": "Objects on color",
    "surfaces": "Surfaces, colored by object",
    "residuals": "Surfaces, colored by residual",
    "tree": "Tree",
}


def _run(program: str, *words: object) -> None:
    subprocess.run([Path(sys.executable).with_name(program), *map(str, words)], check=True)


def _views(folder: Path) -> None:
    saved = folder / "views.rrd"
    _run("nurbseg-live", _RECORDING, "--speed", 0, "--view", "none", "--save", saved)
    with opened(saved, _WAIT_S, _SIZE) as viewer:
        for name, view in _VIEWS.items():
            draw(viewer, folder / f"{name}.png", frame=_FRAME, view=view)


def _mesh(folder: Path) -> None:
    out = folder / "out"
    words = ("--speed", 0, "--view", "none", "--start", _FRAME, "--frames", 1)
    _run("nurbseg-live", _RECORDING, *words, "--export", out, "--export-mesh", "glb")
    stream = rr.RecordingStream("nurbseg_gallery")
    stream.save(folder / "mesh.rrd")
    stream.send_blueprint(
        rr.blueprint.Blueprint(rr.blueprint.Spatial3DView(name="mesh", origin="mesh"), collapse_panels=True)
    )
    stream.log("mesh", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
    stream.log("mesh/objects", rr.Asset3D(path=next(out.glob("*.glb"))))
    stream.flush()
    with opened(folder / "mesh.rrd", _WAIT_S, "1000x800") as viewer:
        draw(viewer, folder / "mesh.png", frame=None, view="mesh")


def _explanation(folder: Path) -> None:
    page = folder / "why.html"
    _run("nurbseg-live", _RECORDING, "--explain", _FRAME, "--explain-out", page)
    # The page begins with the objects.
    page.write_text(
        page.read_text(encoding="utf-8").replace("\nshow(0);", f"\nshow({_STEP});"), encoding="utf-8"
    )
    browser = ("chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars")
    picture = f"--screenshot={folder / 'why.png'}"
    subprocess.run([*browser, "--window-size=1400,960", picture, page.as_uri()], check=True, timeout=60)


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where the pictures go")
    target = parser.parse_args().folder
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for made in (_views, _mesh, _explanation):
            made(folder)
        for path in sorted(folder.glob("*.png")):
            with Image.open(path) as image:
                picture = image.convert("RGB")
                picture.thumbnail((_WIDTH_PX, _WIDTH_PX), Image.Resampling.LANCZOS)
                picture.save(target / f"{path.stem}.webp", quality=80, method=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())
