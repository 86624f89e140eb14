"""Meshes as binary glTF 2.0, with the photo on them."""

import json
import struct
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Intrinsics
from nurbseg.library.surface_mesh import SurfaceMesh

#: Magic bytes, and types of chunks, components, buffers and textures.
_GLTF, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"
_FLOAT, _UINT32, _ARRAY, _ELEMENTS, _CLAMP_TO_EDGE = 5126, 5125, 34962, 34963, 33071
#: A half turn about x: glTF has y up and looks along -z.
_HALF_TURN_X = [1.0, 0.0, 0.0, 0.0]
_MATTE = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 0.9}


def glb(meshes: Mapping[str, SurfaceMesh], photo: NDArray[np.uint8], camera: Intrinsics) -> bytes:
    """Return a binary glTF 2.0 file: a node and a mesh for each object, and the photo as their texture.

    Parameters
    ----------
    meshes : mapping of str to SurfaceMesh
        By name, in the depth camera's frame: x right, y down, z forward.
    photo : (H, W, 3) uint8
        RGB, on the pixels of the depth camera.
    camera : Intrinsics
        The depth camera, which sees each vertex at its place in the photo.
    """
    buffer, views, accessors = bytearray(), [], []

    def added(array: NDArray[Any], target: int, kind: int, shape: str, **more: Any) -> int:
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": array.nbytes, "target": target})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": kind, "count": len(array), "type": shape, **more}
        )
        buffer.extend(array.tobytes())
        return len(accessors) - 1

    objects = []
    for name, mesh in meshes.items():
        vertices_m = mesh.vertices_m
        bounds = {"min": vertices_m.min(axis=0).tolist(), "max": vertices_m.max(axis=0).tolist()}
        primitive = {
            "attributes": {
                "POSITION": added(vertices_m, _ARRAY, _FLOAT, "VEC3", **bounds),
                "NORMAL": added(mesh.normals, _ARRAY, _FLOAT, "VEC3"),
                "TEXCOORD_0": added(_places(vertices_m, camera), _ARRAY, _FLOAT, "VEC2"),
            },
            "indices": added(mesh.triangles.reshape(-1), _ELEMENTS, _UINT32, "SCALAR"),
            "material": 0,
        }
        objects.append({"name": name, "primitives": [primitive]})
    image = cv2.imencode(".png", photo[..., ::-1])[1].tobytes()
    views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(image)})
    buffer.extend(image + bytes(-len(image) % 4))
    document = {
        "asset": {"version": "2.0", "generator": "nurbseg"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "depth camera", "rotation": _HALF_TURN_X, "children": [*range(1, len(meshes) + 1)]},
            *({"name": name, "mesh": number} for number, name in enumerate(meshes)),
        ],
        "meshes": objects,
        "materials": [{"name": "photo", "pbrMetallicRoughness": _MATTE, "doubleSided": True}],
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"bufferView": len(views) - 1, "mimeType": "image/png"}],
        "samplers": [{"wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(buffer)}],
    }
    head = json.dumps(document, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    chunks = b"".join(
        struct.pack("<I4s", len(content), kind) + content for kind, content in ((_JSON, head), (_BIN, buffer))
    )
    return struct.pack("<4sII", _GLTF, 2, 12 + len(chunks)) + chunks


def _places(vertices_m: NDArray[np.float32], camera: Intrinsics) -> NDArray[np.float32]:
    """Return where the camera sees vertices, (N, 2) float32: parts of the image's width and height."""
    matrix, none = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]]), np.zeros(3)
    pixels = cv2.projectPoints(vertices_m.astype(float), none, none, matrix, camera.distortion)[0]
    # The center of the first pixel is half a pixel from the corner.
    places = (pixels.reshape(-1, 2) + 0.5) / (camera.width, camera.height)
    return np.asarray(places, dtype=np.float32)
