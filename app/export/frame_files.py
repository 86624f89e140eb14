"""The files of a frame's result."""

import json
import re
from collections.abc import Mapping
from typing import Any

import cv2
from numpy.typing import NDArray

from nurbseg.app.export.cloud import cloud_file
from nurbseg.app.export.objects import objects_document
from nurbseg.app.export.tree import surfaces_npz, tree_document, tree_graph
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.library.models.model import model_file
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.config import Metric


def frame_files(result: FrameResult, metric: Metric, export: ExportConfig) -> dict[str, bytes]:
    """Return the files of a frame by name, the tree last; `metric` decided the splits."""
    tree = result.tree
    files = {"labels.png": png(result.labels())}
    if tree.objects:
        files["surfaces.png"] = png(result.labels("surfaces"))
        files["objects.png"] = png(result.labels("objects"))
    if export.preview:
        files["preview.png"] = png(cv2.cvtColor(result.picture(), cv2.COLOR_RGB2BGR))
    if export.surfaces:
        files["surfaces.npz"] = surfaces_npz(tree)
    if export.cloud is not None:
        files[f"cloud.{export.cloud}"] = cloud_file(result)
    if export.mesh is not None:
        files[f"mesh.{export.mesh}"] = model_file(result.objects, export.mesh)
    if export.cad is not None:
        files[f"surfaces.{export.cad}"] = model_file(result.objects, export.cad)
    if export.graph:
        files["tree.dot"] = tree_graph(result, metric).encode()
    if export.objects:
        files["objects.json"] = _json(objects_document(result))
    files["tree.json"] = _json(tree_document(result, metric))
    stem = f"{result.frame.index:06d}"
    if export.names == "source" and result.frame.name:
        stem = re.sub(r"[^\w.-]", "_", result.frame.name)
    return {f"{stem}_{name}": content for name, content in files.items()}


def _json(document: Mapping[str, Any]) -> bytes:
    return (json.dumps(document, indent=1) + "\n").encode()


def png(image: NDArray[Any]) -> bytes:
    """Encode an image, BGR if it is in color."""
    return cv2.imencode(".png", image)[1].tobytes()
