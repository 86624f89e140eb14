"""The surfaces of a frame as triangles, by object: GLB or PLY."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Intrinsics
from nurbseg.library.models.forms import MeshForm
from nurbseg.library.models.glb import glb
from nurbseg.library.models.modeled import Modeled
from nurbseg.library.surface_mesh import SurfaceMesh

_PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<u2": "ushort", "<i4": "int"}
_PLY_NAMES = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "object")
_PLY_KINDS = ["<f4"] * 6 + ["|u1"] * 3 + ["<u2"]


def mesh_file(objects: Sequence[Modeled], form: MeshForm) -> bytes:
    """Return the fitted surfaces of a frame's objects as triangles, meters in the depth camera's frame.

    In GLB each object has its name (``object 3``), and the photo is the texture; GLB rotates the frame (x
    right, y down, z forward) to glTF's convention. In PLY each vertex has the label and the mean color of its
    object.
    """
    meshes = [(each, mesh) for each in objects if len((mesh := each.mesh()).triangles)]
    if form == "ply":
        return _ply(meshes)
    named = {each.name: mesh for each, mesh in meshes}
    if not objects:
        return glb(named, np.zeros((1, 1, 3), np.uint8), Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0))
    return glb(named, objects[0].cloud.color, objects[0].camera)


def _ply(meshes: Sequence[tuple[Modeled, SurfaceMesh]]) -> bytes:
    vertices = [np.empty(0, dtype=[*zip(_PLY_NAMES, _PLY_KINDS, strict=True)])]
    triangles, first = [np.zeros((0, 3), dtype=np.int64)], 0
    for each, mesh in meshes:
        color = np.rint(each.mean_color).astype(np.uint8)
        columns = (*mesh.vertices_m.T, *mesh.normals.T, *color, each.label)
        vertices.append(np.rec.fromarrays(np.broadcast_arrays(*columns), dtype=vertices[0].dtype))
        triangles.append(mesh.triangles.astype(np.int64) + first)
        first += len(mesh.vertices_m)
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
