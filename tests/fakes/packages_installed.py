"""Packages that tests install: small ones of a single module, laid out as pip does."""

from __future__ import annotations

from pathlib import Path


def install(folder: Path, name: str, code: str, entries: str) -> Path:
    """Install a module and its entry points for `nurbseg.sources` into a folder; return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.py").write_text(code)
    described = folder / f"{name}-1.5.dist-info"
    described.mkdir()
    (described / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.5\n")
    (described / "entry_points.txt").write_text(entries)
    return folder
