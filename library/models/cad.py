"""The surfaces of a frame as NURBS for CAD programs."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

from nurbseg.common.errors import BackendMissingError
from nurbseg.library.models.forms import CadForm, missing_library
from nurbseg.library.models.rhino import write_rhino
from nurbseg.library.models.step import write_step
from nurbseg.library.objects import MeasuredObject


def cad_file(objects: Sequence[MeasuredObject], form: CadForm) -> bytes:
    """Return a file of the surfaces of objects; raises BackendMissingError if a library is missing."""
    if missing := missing_library(form):
        raise BackendMissingError(f"{form}: {missing}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"surfaces.{form}"
        {"3dm": write_rhino, "step": write_step}[form](objects, path)
        return path.read_bytes()
