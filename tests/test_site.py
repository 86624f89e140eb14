"""The documentation's site: all pages are in it, links hold, and nothing of it comes from another host."""

from __future__ import annotations

import importlib.util
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from enum import Enum
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from nurbseg.common.settings import Settings, described_fields, setting_paths, subsections
from nurbseg.segmentation.config import SegmentationConfig

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
BESIDE = {ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "recordings/README.md")}
#: Pages that a reader finds in the navigation; the index holds the text of docs/README.md.
PAGES = BESIDE | {*DOCS.glob("*.md"), *DOCS.glob("*.rst")} - {DOCS / "index.md", DOCS / "README.md"}
PACKAGES = ("nurbseg", "nurbseg.segmentation", "nurbseg.drivers", "nurbseg.testing")


def navigation() -> list[Path]:
    """Pages of the navigation, in order."""
    found = []
    for block in re.findall(r"```\{toctree\}\n(.*?)```", (DOCS / "index.md").read_text(), re.DOTALL):
        for line in filter(None, block.splitlines()):
            if not line.startswith(":"):
                name = re.sub(r".*<(.*)>", r"\1", line)
                (page,) = [page for end in (".md", ".rst") if (page := DOCS / f"{name}{end}").exists()]
                found.append(page.resolve())
    return found


def links(page: Path) -> set[str]:
    """What a page links to and shows, without what is on other hosts and without the place in the page."""
    return set(re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()))


def test_every_page_is_in_the_navigation_once() -> None:
    pages = navigation()
    assert sorted(pages) == sorted(PAGES)


def test_the_index_lists_every_page_in_the_order_of_the_navigation() -> None:
    told = re.findall(r"\| [^|]*\[[^|]* \|", (DOCS / "README.md").read_text())
    linked = [(DOCS / link).resolve() for row in told for link in re.findall(r"\]\((.*?)\)", row)]
    assert linked == [page for page in navigation() if page != ROOT / "README.md"]


@pytest.mark.parametrize("page", sorted(PAGES | {DOCS / "README.md"}), ids=lambda page: page.name)
def test_what_a_page_links_to_exists(page: Path) -> None:
    assert not {link for link in links(page) if not (page.parent / link).exists()}


@pytest.mark.parametrize("page", sorted(PAGES), ids=lambda page: page.name)
def test_a_page_shows_nothing_of_another_host(page: Path) -> None:
    assert not re.findall(r"!\[[^\]]*\]\(\s*(?:\w+:|//)|<(?:img|script|link|iframe)\b", page.read_text())


def named_on_the_page() -> list[str]:
    text = (DOCS / "api.rst").read_text()
    return re.findall(r"^\.\. (?:autoclass|autofunction|autoexception|data):: (\S+)$", text, re.MULTILINE)


def public() -> dict[str, Any]:
    """Every public name with what it stands for; what two packages export is there twice."""
    names = [(package, name) for package in PACKAGES for name in import_module(package).__all__]
    return {
        f"{package}.{name}": None if name == "__version__" else getattr(import_module(package), name)
        for package, name in names
    }


def test_every_public_name_is_on_the_page_of_the_api_once() -> None:
    known, named = public(), named_on_the_page()
    assert set(named) <= set(known)
    assert len({id(known[name]) for name in named}) == len(named)
    assert {id(each) for each in known.values()} == {id(known[name]) for name in named}


def parameters_told(documented: object) -> list[str]:
    section = re.search(
        r"^Parameters\n-+\n(.*?)(?=^\w+\n-+\n|\Z)", inspect.getdoc(documented) or "", re.M | re.S
    )
    lines = re.findall(r"^(\w[\w, ]*) : ", section[1], re.MULTILINE) if section else []
    return [name for line in lines for name in line.split(", ")]


@pytest.mark.parametrize("name", [name for name in named_on_the_page() if not name.endswith("__")])
def test_a_public_name_is_documented_with_all_that_it_takes(name: str) -> None:
    documented = public()[name]
    own = documented.__doc__ or ""
    assert re.match(r"[A-Z`].*\.$", own.splitlines()[0] if own else ""), own
    if isinstance(documented, type) and issubclass(documented, Exception | Enum):
        return
    taken = list(inspect.signature(documented).parameters)
    told = parameters_told(documented)
    if isinstance(documented, type) and issubclass(documented, Settings):
        told += [*(field.name for field in described_fields(documented)), *subsections(documented)]
    assert told == taken


def test_every_setting_has_a_meaning() -> None:
    assert all(field.metadata["text"] for _, field in setting_paths(SegmentationConfig))


class _Loaded(HTMLParser):
    """What a browser asks for by itself when it shows a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        wanted = {"src", "srcset", "data", "poster"} | (
            {"href"} if tag in ("link", "image", "use") else set()
        )
        self.found += [value for name, value in attrs if name in wanted and value]


def loaded(site: Path) -> Iterator[tuple[Path, str]]:
    """What the files of a site ask for, file by file."""
    for path in site.rglob("*"):
        if path.suffix == ".html":
            yield from ((path, each) for each in _Loaded(path.read_text()).found)
        elif path.suffix == ".css":
            style = path.read_text()
            yield from ((path, each) for each in re.findall(r"url\(\s*[\"']?([^\"')]+)", style))
            yield from ((path, each) for each in re.findall(r"@import\s+[\"']([^\"']+)", style))


@pytest.mark.skipif(
    importlib.util.find_spec("furo") is None,
    reason="what makes the site is not installed: make docs installs it",
)
def test_the_site_is_made_without_a_warning_and_asks_no_other_host(tmp_path: Path) -> None:
    (rule,) = re.findall(r"sphinx-build (.*) --doctree-dir", (ROOT / "Makefile").read_text())
    site = tmp_path / "site"
    words = [*rule.split(), "--doctree-dir", str(tmp_path / "trees"), ".", str(site)]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words], cwd=ROOT, capture_output=True, text=True, timeout=280
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    made = {page.relative_to(site) for page in site.rglob("*.html")}
    assert made >= {page.relative_to(ROOT).with_suffix(".html") for page in PAGES}
    asked = list(loaded(site))
    assert len(asked) > len(PAGES)
    others = [(path, each) for path, each in asked if re.match(r"(?!data:)\w+:|//", each)]
    assert not others
    # What documents settings is made of their fields, what documents the rest of the docstrings.
    api = (site / "docs" / "api.html").read_text()
    assert all(f"<strong>{path}</strong>" in api for path, _ in setting_paths(SegmentationConfig))
    assert all(f'id="{name}"' in api for name in named_on_the_page())


def render_settings() -> Any:
    spec = importlib.util.spec_from_file_location("render_settings", DOCS / "render_settings.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_settings_shows_every_picture_that_is_drawn_and_they_are_small() -> None:
    shown = {link for link in links(DOCS / "settings.md") if "/settings/" in link}
    assert shown == {f"images/settings/{name}.jpg" for name in render_settings().DRAWN}
    assert {path.name for path in (DOCS / "images/settings").iterdir()} == {Path(link).name for link in shown}
    assert sum((DOCS / link).stat().st_size for link in shown) < 400_000


def test_the_middle_picture_of_a_row_is_the_default() -> None:
    defaults = {field.name: field.default for _, field in setting_paths(SegmentationConfig)}
    series = render_settings().SERIES
    assert len(series) > 5
    assert {name: values[1] for name, (_, values) in series.items()} == {
        name: defaults[name] for name in series
    }


def test_a_setting_shows_in_its_pictures(tmp_path: Path) -> None:
    words = [DOCS / "render_settings.py", tmp_path / "here", "--only", "log_odds_min"]
    subprocess.run([sys.executable, *map(str, words)], timeout=280, check=True)
    (path,) = (tmp_path / "here").iterdir()
    strip = cv2.imread(str(path)).astype(int)
    committed = cv2.imread(str(DOCS / "images/settings" / path.name))
    assert strip.shape == committed.shape
    low, default, high = (strip[22:, at : at + 280] for at in (0, 284, 568))
    for other in (low, high):
        assert np.mean(np.abs(other - default).max(axis=2) > 40) > 0.01
