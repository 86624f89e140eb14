"""The surfaces of a frame as triangles, by object: GLB, OBJ or PLY."""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.export.cloud import ply
from nurbseg.app.settings.export_config import MeshForm
from nurbseg.library.result import FrameResult
from nurbseg.library.surface_mesh import SurfaceMesh

#: GLB: magic bytes, and types of chunks, components and buffers.
_GLTF, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"
_FLOAT, _UINT32, _ARRAY, _ELEMENTS = 5126, 5125, 34962, 34963
_PLY_NAMES = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "object")
_PLY_KINDS = ["<f4"] * 6 + ["|u1"] * 3 + ["<u2"]
#: A half turn about x: glTF has y up and looks along -z.
_HALF_TURN_X = [1.0, 0.0, 0.0, 0.0]


@dataclass(frozen=True, slots=True, eq=False)
class _ObjectMesh:
    """The triangles of an object."""

    name: str
    label: int
    color: NDArray[np.uint8]
    mesh: SurfaceMesh


def mesh_file(result: FrameResult, form: MeshForm) -> bytes:
    """Return the fitted surfaces of a frame as triangles, meters in the depth camera's frame.

    In GLB and OBJ each object has a name (``object 3``), in PLY each vertex has its label. The color is the
    object's mean color. GLB rotates the frame (x right, y down, z forward) to glTF's convention.
    """
    kind = "object" if result.tree.objects else "surface"
    meshes = [
        _ObjectMesh(f"{kind} {each.label}", each.label, np.rint(each.mean_color).astype(np.uint8), mesh)
        for each in result.objects
        if len((mesh := each.mesh()).triangles)
    ]
    return {"glb": _glb, "obj": _obj, "ply": _ply}[form](meshes)


def _ply(meshes: Sequence[_ObjectMesh]) -> bytes:
    vertices = [np.empty(0, dtype=[*zip(_PLY_NAMES, _PLY_KINDS, strict=True)])]
    triangles, first = [np.zeros((0, 3), dtype=np.int64)], 0
    for each in meshes:
        columns = (*each.mesh.vertices_m.T, *each.mesh.normals.T, *each.color, each.label)
        vertices.append(np.rec.fromarrays(np.broadcast_arrays(*columns), dtype=vertices[0].dtype))
        triangles.append(each.mesh.triangles.astype(np.int64) + first)
        first += len(each.mesh.vertices_m)
    faces = np.empty(sum(map(len, triangles)), dtype=[("count", "|u1"), ("vertex_indices", "<i4", (3,))])
    faces["count"], faces["vertex_indices"] = 3, np.concatenate(triangles)
    return ply(vertex=np.concatenate(vertices), face=faces)


def _obj(meshes: Sequence[_ObjectMesh]) -> bytes:
    lines, first = ["# meters; x right, y down, z forward"], 1
    for each in meshes:
        mesh = each.mesh
        lines.append(f"o {each.name.replace(' ', '_')}")
        red, green, blue = (each.color / 255.0).round(4).tolist()
        lines += [f"v {x:.6f} {y:.6f} {z:.6f} {red} {green} {blue}" for x, y, z in mesh.vertices_m.tolist()]
        lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in mesh.normals.tolist()]
        lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (mesh.triangles + first).tolist()]
        first += len(mesh.vertices_m)
    return ("\n".join(lines) + "\n").encode()


def _glb(meshes: Sequence[_ObjectMesh]) -> bytes:
    """Return a binary glTF 2.0 file: a node and a mesh for each object, one buffer for all."""
    buffer, views, accessors = bytearray(), [], []

    def added(array: NDArray[Any], target: int, kind: int, shape: str, **more: Any) -> int:
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": array.nbytes, "target": target})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": kind, "count": len(array), "type": shape, **more}
        )
        buffer.extend(array.tobytes())
        return len(accessors) - 1

    objects = []
    for number, each in enumerate(meshes):
        vertices_m = each.mesh.vertices_m
        bounds = {"min": vertices_m.min(axis=0).tolist(), "max": vertices_m.max(axis=0).tolist()}
        primitive = {
            "attributes": {
                "POSITION": added(vertices_m, _ARRAY, _FLOAT, "VEC3", **bounds),
                "NORMAL": added(each.mesh.normals, _ARRAY, _FLOAT, "VEC3"),
            },
            "indices": added(each.mesh.triangles.reshape(-1), _ELEMENTS, _UINT32, "SCALAR"),
            "material": number,
        }
        objects.append({"name": each.name, "primitives": [primitive]})
    document = {
        "asset": {"version": "2.0", "generator": "nurbseg"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "depth camera", "rotation": _HALF_TURN_X, "children": [*range(1, len(meshes) + 1)]},
            *({"name": each.name, "mesh": number} for number, each in enumerate(meshes)),
        ],
        "meshes": objects,
        "materials": [_material(each) for each in meshes],
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


def _material(each: _ObjectMesh) -> dict[str, Any]:
    # glTF's colors are linear, those of images sRGB.
    linear = ((each.color / 255.0) ** 2.2).round(4).tolist()
    surface = {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.9}
    return {"name": each.name, "pbrMetallicRoughness": surface, "doubleSided": True}
