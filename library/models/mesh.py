"""The surfaces of a frame as triangles, by object: GLB, OBJ, PLY or STL."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Intrinsics
from nurbseg.library.models.forms import MeshForm
from nurbseg.library.models.glb import glb
from nurbseg.library.objects import MeasuredObject
from nurbseg.library.surface_mesh import SurfaceMesh

_PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<u2": "ushort", "<i4": "int"}
_PLY_NAMES = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "object")
_PLY_KINDS = ["<f4"] * 6 + ["|u1"] * 3 + ["<u2"]


@dataclass(frozen=True, slots=True, eq=False)
class _ObjectMesh:
    """The triangles of an object."""

    name: str
    label: int
    color: NDArray[np.uint8]
    mesh: SurfaceMesh


def mesh_file(objects: Sequence[MeasuredObject], form: MeshForm, camera: Intrinsics) -> bytes:
    """Return the fitted surfaces of a frame's objects as triangles, meters in the depth camera's frame.

    In GLB and OBJ each object has its name (``object 3``), in PLY each vertex has its label; STL has neither
    names nor colors. In GLB the photo is the texture, for which `camera` is the depth camera; otherwise
    the color is the object's mean color. GLB rotates the frame (x right, y down, z forward) to glTF's
    convention.
    """
    meshes = [
        _ObjectMesh(each.name, each.label, np.rint(each.mean_color).astype(np.uint8), mesh)
        for each in objects
        if len((mesh := each.mesh()).triangles)
    ]
    if form == "glb":
        photo = objects[0].cloud.color if objects else np.zeros((1, 1, 3), np.uint8)
        return glb({mesh.name: mesh.mesh for mesh in meshes}, photo, camera)
    return {"obj": _obj, "ply": _ply, "stl": _stl}[form](meshes)


def _stl(meshes: Sequence[_ObjectMesh]) -> bytes:
    """Return a binary STL file, whose triangles have their normal and their corners."""
    none = np.zeros((0, 3, 3), dtype=np.float32)
    corners = np.concatenate([none, *(mesh.mesh.vertices_m[mesh.mesh.triangles] for mesh in meshes)])
    records = np.zeros(
        len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("none", "<u2")]
    )
    records["corners"] = corners
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    records["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    return (
        struct.pack("<80sI", b"nurbseg: meters, x right, y down, z forward", len(corners)) + records.tobytes()
    )


def _ply(meshes: Sequence[_ObjectMesh]) -> bytes:
    vertices = [np.empty(0, dtype=[*zip(_PLY_NAMES, _PLY_KINDS, strict=True)])]
    triangles, first = [np.zeros((0, 3), dtype=np.int64)], 0
    for mesh in meshes:
        columns = (*mesh.mesh.vertices_m.T, *mesh.mesh.normals.T, *mesh.color, mesh.label)
        vertices.append(np.rec.fromarrays(np.broadcast_arrays(*columns), dtype=vertices[0].dtype))
        triangles.append(mesh.mesh.triangles.astype(np.int64) + first)
        first += len(mesh.mesh.vertices_m)
    faces = np.empty(sum(map(len, triangles)), dtype=[("count", "|u1"), ("vertex_indices", "<i4", (3,))])
    faces["count"], faces["vertex_indices"] = 3, np.concatenate(triangles)
    return ply(vertex=np.concatenate(vertices), face=faces)


def ply(**elements: NDArray[np.void]) -> bytes:
    """Return a PLY file of elements, (N,) records each.

    A field with several numbers becomes a list, whose length must precede it as a field ``count``.
    """
    head = ["ply", "format binary_little_endian 1.0", "comment meters; x right, y down, z forward"]
    content = []
    for element, records in elements.items():
        head.append(f"element {element} {records.size}")
        for name, (kind, *_) in (records.dtype.fields or {}).items():
            if kind.shape:
                head.append(f"property list uchar {_PLY_TYPES[kind.base.str]} {name}")
            elif name != "count":
                head.append(f"property {_PLY_TYPES[kind.str]} {name}")
        content.append(records.tobytes())
    return ("\n".join([*head, "end_header"]) + "\n").encode() + b"".join(content)


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
