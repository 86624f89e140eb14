"""3-D models of objects as files."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

from nurbseg.common.errors import BackendMissingError
from nurbseg.common.files import write_atomically
from nurbseg.library.models.forms import ModelForm, form_of, missing_library
from nurbseg.library.models.mesh import mesh_file
from nurbseg.library.models.modeled import Modeled


def model_file(objects: Sequence[Modeled], form: ModelForm) -> bytes:
    """Return the surfaces of a frame's objects as a file.

    Raises BackendMissingError if a library is missing.
    """
    if form != "step":
        return mesh_file(objects, form)
    if missing := missing_library():
        raise BackendMissingError(f"step: {missing}")
    from nurbseg.library.models.step import write_step

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "surfaces.step"
        write_step(objects, path)
        return path.read_bytes()


def export(objects: Sequence[Modeled], path: str | Path) -> None:
    """Write the surfaces of a frame's objects to a file, as `FrameResult.export` says."""
    path = Path(path)
    write_atomically(path, model_file(objects, form_of(path)))
