"""Settings of the files written for each frame and for the run."""

from dataclasses import Field, dataclass
from typing import Any, Literal

from nurbseg.common.settings import Settings, described_fields, setting
from nurbseg.library.models.forms import CadForm, MeshForm

CloudForm = Literal["ply", "pcd"]
Naming = Literal["number", "source"]


@dataclass(frozen=True, slots=True)
class ExportConfig(Settings):
    """Settings of the files written for each frame and for the run."""

    directory: str | None = setting(
        None,
        "folder for each frame's labels (PNG) and tree (JSON)",
        unit="DIR",
        flag="export",
    )
    surfaces: bool = setting(False, "also export the fitted surfaces (NPZ)", flag="export-surfaces")
    objects: bool = setting(
        False,
        "also export measurements of each object (JSON), and of all objects in a table (CSV)",
        flag="export-objects",
    )
    preview: bool = setting(
        False, "also export the frame with its objects outlined and numbered (PNG)", flag="export-preview"
    )
    cloud: CloudForm | None = setting(
        None,
        "also export the point cloud, with color, normal, surface and object",
        flag="export-cloud",
    )
    mesh: MeshForm | None = setting(
        None,
        "also export the surfaces as triangles, trimmed to their pixels, one part per object; in glb with "
        "the photo",
        flag="export-mesh",
    )
    cad: CadForm | None = setting(
        None,
        "also export the surfaces as NURBS, by object: trimmed in step (needs the extra 'step'), with "
        "outlines in 3dm (needs the extra 'cad')",
        flag="export-cad",
    )
    graph: bool = setting(False, "also export the tree as a graph for Graphviz (DOT)", flag="export-graph")
    names: Naming = setting(
        "number",
        "file names of a frame: its number, or its name in the source",
        flag="export-names",
    )
    report: str | None = setting(
        None, "file for the run's statistics: frames, drops, frame rate, latency, memory (JSON)", unit="FILE"
    )
    force: bool = setting(
        False, "overwrite existing results, reports and viewer files; recordings are never overwritten"
    )


def export_forms() -> list[Field[Any]]:
    """Return the settings of a frame's optional files and of file names."""
    return [each for each in described_fields(ExportConfig) if each.metadata["flag"].startswith("export-")]
