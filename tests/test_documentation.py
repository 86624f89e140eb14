"""What README and docs tell to type: each piece of Python is run, page by page."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nurbseg.segmentation.points.registration import PointMap

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
#: Pieces behind a marker with a name are run by the tests of what they tell of, with the data that they need.
_PYTHON = re.compile(r"(<!-- run by the tests: \w+ -->\n)?```python\n(.*?)```", re.DOTALL)


def programs() -> list[tuple[str, str]]:
    """Pages that hold Python, and all of it that is run here, in order, as one program."""
    found = []
    for page in PAGES:
        pieces = [piece for marked, piece in _PYTHON.findall(page.read_text()) if not marked]
        if pieces:
            found.append((str(page.relative_to(ROOT)), "\n".join(pieces)))
    return found


@pytest.mark.parametrize(("page", "program"), programs(), ids=lambda each: each if ".md" in each else "")
def test_the_python_of_a_page_runs(page: str, program: str, tmp_path: Path) -> None:
    (tmp_path / "recordings").symlink_to(ROOT / "recordings")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_the_method_of_the_page_on_evaluation_gives_labels() -> None:
    (marked,) = re.findall(
        r"tests: method -->\n```python\n(.*?)```", (ROOT / "docs/evaluation.md").read_text(), re.DOTALL
    )
    scope: dict[str, Any] = {"np": np}
    exec(marked, scope)
    points_m = np.full((2, 3, 3), np.nan, dtype=np.float32)
    points_m[0] = [[0.0, 0.0, 0.4], [0.0, 0.0, 0.6], [0.0, 0.0, 1.2]]
    cloud = PointMap(points_m, np.zeros((2, 3, 3), dtype=np.uint8), np.ones((2, 3), dtype=bool))
    assert scope["by_distance"](cloud, None).tolist() == [[1, 2, 3], [0, 0, 0]]


def test_pages_with_python_are_found() -> None:
    assert {"README.md", "docs/library.md"} <= {page for page, _ in programs()}
