"""The formats of 3-D models, and the libraries that they need."""

from importlib.util import find_spec
from pathlib import Path
from typing import Literal, TypeVar

MeshForm = Literal["glb", "obj", "ply", "stl"]
CadForm = Literal["3dm", "step"]

#: Modules that a format needs, and the extra that brings them.
_NEEDED = {"3dm": (("rhino3dm",), "cad"), "step": (("OCP", "shapely"), "step")}


def missing_library(form: CadForm) -> str:
    """Return what a format needs but is missing, and how to install it; empty if nothing is."""
    modules, extra = _NEEDED[form]
    missing = [module for module in modules if find_spec(module) is None]
    if not missing:
        return ""
    return (
        f"needs {missing[0]}, part of the extra '{extra}': pip install 'nurbseg[{extra}]' "
        f"(in the project's folder: pip install '.[{extra}]')"
    )


Form = TypeVar("Form", MeshForm, CadForm)


def form_of(path: Path, forms: tuple[Form, ...]) -> Form:
    """Return the format that a file's name ends in; raises ValueError if it is none of `forms`."""
    for form in forms:
        if path.suffix.lower() == f".{form}":
            return form
    raise ValueError(f"{path}: expected a name that ends in {', '.join(f'.{form}' for form in forms)}")
