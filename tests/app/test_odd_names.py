"""Names of files that are not UTF-8, or look like options."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

COMMANDS = os.fsencode(Path(sys.executable).parent)


def run(folder: Path, command: bytes, *words: bytes) -> bytes:
    """Run a command of ours in a folder; return what it prints."""
    done = subprocess.run([COMMANDS + b"/" + command, *words], cwd=folder, capture_output=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", [b"caf\xe9", b"-dash", b"new\nline", b"space "])
def test_a_folder_of_any_name_is_replayed_exported_recorded_and_saved(tmp_path, name):
    folder = os.fsencode(tmp_path) + b"/" + name
    os.mkdir(folder)  # noqa: PTH102 (bytes)
    rows, columns = np.mgrid[:96, :128]
    depth_mm = np.where(columns < 64, 1000, 1500).astype(np.uint16)
    for number, shift in enumerate((0, 1)):
        key = folder + b"/" + name + b"%d" % number
        color = np.dstack([rows, columns, columns + shift]).astype(np.uint8)
        for what, image in ((b"color", color), (b"depth", depth_mm)):
            with open(key + b"_" + what + b".png", "wb") as file:  # noqa: PTH123 (the name is bytes)
                file.write(cv2.imencode(".png", image)[1].tobytes())
    run(
        tmp_path,
        b"nurbseg-live",
        *(b"--replay=" + name, b"--record=" + name + b".mcap", b"--save=" + name + b".rrd"),
        *b"--intrinsics 100,100,63.5,47.5 --speed 0 --view none".split(),
        *b"--export out --export-names source --export-objects".split(),
    )
    assert len(list((tmp_path / "out").glob("*_labels.png"))) == 2
    assert b"2 frames" in run(tmp_path, b"nurbseg-record", b"check", b"./" + name + b".mcap")
