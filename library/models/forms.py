"""The formats of 3-D models, and the libraries that they need."""

from importlib.util import find_spec
from pathlib import Path
from typing import Literal, get_args

MeshForm = Literal["glb", "ply"]
CadForm = Literal["step"]
ModelForm = MeshForm | CadForm

#: Modules that STEP needs.
_STEP_MODULES = ("OCP", "shapely")


def missing_library() -> str:
    """Return the library that STEP needs but that is missing, and how to install it; empty if none is."""
    missing = [module for module in _STEP_MODULES if find_spec(module) is None]
    if not missing:
        return ""
    return (
        f"needs {missing[0]}, part of the extra 'step': pip install 'nurbseg[step]' "
        "(in the project's folder: pip install '.[step]')"
    )


def form_of(path: Path) -> ModelForm:
    """Return the format that a file's name ends in; raises ValueError if it is none."""
    forms: tuple[ModelForm, ...] = (*get_args(MeshForm), *get_args(CadForm))
    for form in forms:
        if path.suffix.lower() == f".{form}":
            return form
    raise ValueError(f"{path}: expected a name that ends in {', '.join(f'.{form}' for form in forms)}")
