"""What is written of each frame's result, and of the run."""

from __future__ import annotations

from dataclasses import Field, dataclass
from typing import Any, Literal, get_args

from nurbseg.drivers.settings import Settings, described_fields, setting

CloudForm = Literal["ply", "pcd"]
MeshForm = Literal["glb", "obj", "ply"]
CadForm = Literal["3dm"]
Naming = Literal["number", "source"]


@dataclass(frozen=True, slots=True)
class ExportConfig(Settings):
    """What is written of each frame's result, and of the run."""

    directory: str | None = setting(
        None,
        "folder for each frame's labels (PNG) and tree (JSON)",
        unit="DIR",
        flag="export",
    )
    surfaces: bool = setting(False, "export the fitted surfaces too (NPZ)", flag="export-surfaces")
    objects: bool = setting(
        False,
        "export what is measured of each object too (JSON), and of all in a table (CSV)",
        flag="export-objects",
    )
    preview: bool = setting(
        False, "export the labels in colors over the frame too (PNG)", flag="export-preview"
    )
    cloud: CloudForm | None = setting(
        None,
        "export the points too, with color, normal, surface and object",
        choices=get_args(CloudForm),
        flag="export-cloud",
    )
    mesh: MeshForm | None = setting(
        None,
        "export the surfaces as triangles too, cut to their pixels, an object each",
        choices=get_args(MeshForm),
        flag="export-mesh",
    )
    cad: CadForm | None = setting(
        None,
        "export the surfaces as NURBS too, a layer for each object (needs the extra 'cad')",
        choices=get_args(CadForm),
        flag="export-cad",
    )
    graph: bool = setting(False, "export the tree as a graph for Graphviz too (DOT)", flag="export-graph")
    names: Naming = setting(
        "number",
        "what a frame's files are named by: its number, or its name in the source",
        choices=get_args(Naming),
        flag="export-names",
    )
    report: str | None = setting(
        None, "file for the run's figures: frames, drops, rate, latency, memory (JSON)", unit="FILE"
    )
    force: bool = setting(
        False, "replace results, reports and viewer files that exist; recordings are never replaced"
    )


def export_forms() -> list[Field[Any]]:
    """Return the settings that say what else is written of a frame, and under which names."""
    return [each for each in described_fields(ExportConfig) if each.metadata["flag"].startswith("export-")]
