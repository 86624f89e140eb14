"""Corrected labels as files: a folder of labeled pairs of images, and the same as COCO's JSON.

A folder holds ``NAME_color.png`` (on the depth camera's grid), ``NAME_depth.png`` (millimeters),
``NAME_label.png`` and ``calibration.yml``, to be replayed and scored, and ``annotations.json``. NAME is the
frame's name in its source, or else its number.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.files import read_json, write_atomically
from nurbseg.common.frame import Intrinsics, RGBDFrame
from nurbseg.library.result import FrameResult

#: Annotations are numbered by image, and within it by the label, which has 16 bits.
_LABELS = 1 << 16


def file_stem(frame: RGBDFrame) -> str:
    """Return what the files of a frame are called: by its name in the source, or else by its number."""
    return re.sub(r"[^\w.-]", "_", frame.name) or f"{frame.index:06d}"


def save_labels(result: FrameResult, folder: Path) -> Path:
    """Add a frame's images, its labels of objects, and its camera to a folder; return the label image.

    Parameters
    ----------
    result : FrameResult
        The frame. Files of the same frame are replaced.
    folder : Path
        Made if it is missing.

    Raises
    ------
    ValueError
        If the folder is that of another camera, or has files that cannot be read.
    OSError
        If a file cannot be written.
    """
    # Images are private.
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    frame, labels, stem = result.frame, result.labels("objects"), file_stem(result.frame)
    camera, camera_file = _camera_text(frame.calibration.depth), folder / "calibration.yml"
    if camera_file.exists() and camera_file.read_text() != camera:
        raise ValueError(f"{camera_file}: is of another camera; save to another folder")
    annotations_file = folder / "annotations.json"
    document = read_json(annotations_file) if annotations_file.exists() else {}
    try:
        document = _with_frame(document, f"{stem}_color.png", labels)
    except (AttributeError, KeyError, TypeError) as err:
        raise ValueError(f"{annotations_file}: is no file of COCO's form ({err!r})") from err
    color = frame.color if frame.calibration.is_registered else result.cloud.color
    images = {"color": cv2.cvtColor(color, cv2.COLOR_RGB2BGR), "depth": frame.depth_mm, "label": labels}
    for kind, image in images.items():
        write_atomically(folder / f"{stem}_{kind}.png", cv2.imencode(".png", image)[1].tobytes())
    write_atomically(camera_file, camera.encode())
    write_atomically(annotations_file, json.dumps(document, separators=(",", ":")).encode())
    return folder / f"{stem}_label.png"


def _camera_text(camera: Intrinsics) -> str:
    """Return a camera as OpenCV's YAML."""
    file = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.write("image_width", camera.width)
    file.write("image_height", camera.height)
    file.write("camera_matrix", camera.matrix)
    if camera.distortion.size:
        file.write("distortion_coefficients", camera.distortion[None])
    return file.releaseAndGetString()


def _with_frame(document: dict[str, Any], file_name: str, labels: NDArray[np.uint16]) -> dict[str, Any]:
    """Return COCO's document with an image and its objects, in place of those of the same name."""
    images = {each["file_name"]: each["id"] for each in document.get("images", [])}
    number = images.setdefault(file_name, 1 + max(images.values(), default=0))
    height, width = labels.shape
    own = [_annotation(labels == label, number, label) for label in np.unique(labels[labels > 0]).tolist()]
    others = [each for each in document.get("annotations", []) if each["image_id"] != number]
    image = {"id": number, "file_name": file_name, "width": width, "height": height}
    return document | {
        "images": [*(each for each in document.get("images", []) if each["id"] != number), image],
        "annotations": others + own,
        "categories": document.get("categories") or [{"id": 1, "name": "object"}],
    }


def _annotation(mask: NDArray[np.bool_], image: int, label: int) -> dict[str, Any]:
    """Return an object with its mask as runs along the columns, of the background first."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    left, top = int(columns[0]), int(rows[0])
    changes = np.flatnonzero(np.diff(mask.ravel(order="F"), prepend=False))
    return {
        "id": image * _LABELS + label,
        "image_id": image,
        "category_id": 1,
        "label": label,
        "iscrowd": 0,
        "area": int(np.count_nonzero(mask)),
        "bbox": [left, top, int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top],
        "segmentation": {
            "size": list(mask.shape),
            "counts": np.diff(changes, prepend=0, append=mask.size).tolist(),
        },
    }
