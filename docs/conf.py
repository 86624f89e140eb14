"""How Sphinx makes the documentation's site: `make docs`. It reads the whole project, so that links hold."""

from __future__ import annotations

import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from docutils.nodes import SkipNode, math_block
from latex2mathml.converter import convert
from numpydoc.xref import DEFAULT_LINKS

from nurbseg.common.settings import Settings, choices, setting_paths

_ROOT = Path(__file__).resolve().parent.parent

project = "nurbseg"
release = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]["version"]
extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/*.md", "docs/*.rst", "recordings/*.md"]
# The index has the text of docs/README.md, and the navigation beside it.
exclude_patterns = ["docs/README.md", ".*", "build", "out", "site"]
highlight_language = "none"
default_role = "py:obj"

myst_heading_anchors = 3
# Formulas are TeX between dollar signs, and MathML on the site: browsers set it by themselves.
myst_enable_extensions = ["dollarmath"]
html_math_renderer = "mathml"
numpydoc_show_class_members = False
# Types are links where they are ours; the manuals of others are on other hosts.
DEFAULT_LINKS.clear()
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = {
    name: f"{package}.{name}"
    for package in ("nurbseg.drivers", "nurbseg.segmentation", "nurbseg")
    for name in import_module(package).__all__
}
# Docstrings tell types, together with shapes and units.
autodoc_typehints = "none"
autodoc_member_order = "bysource"

# Nothing of this theme comes from another host, and it searches without a server.
html_theme = "furo"
html_title = f"nurbseg {release}"
html_extra_path = ["index.html"]
html_copy_source = False
html_show_copyright = False


def _tell_settings(
    _app: Any, _what: str, _name: str, documented: object, _options: Any, lines: list[str]
) -> None:
    """Add the fields of a configuration to its docstring, which they describe themselves."""
    if not (isinstance(documented, type) and issubclass(documented, Settings)):
        return
    lines += ["", "Parameters", "----------"]
    for path, each in setting_paths(documented):
        words, unit = choices(each), each.metadata["unit"]
        kind = f"{{{', '.join(words)}}}" if words else type(each.default).__name__
        lines.append(f"{path} : {kind}{unit and ', '}{unit}, default {each.default}")
        lines.append(f"    {each.metadata['text']}")


def _set_formula(translator: Any, node: Any) -> NoReturn:
    """Write a formula as MathML, on a line of its own unless it is part of a sentence."""
    is_block = isinstance(node, math_block)
    formula = convert(node.astext(), display="block" if is_block else "inline")
    translator.body.append(f'<div class="math">{formula}</div>' if is_block else formula)
    raise SkipNode


def setup(app: Any) -> None:
    """Have settings told before numpydoc reads the docstrings, and formulas set."""
    app.connect("autodoc-process-docstring", _tell_settings, priority=100)
    app.add_html_math_renderer("mathml", (_set_formula, None), (_set_formula, None))
