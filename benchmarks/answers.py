"""Hash what the segmentation answers, to show that a change of structure changes no answer.

Every source is exported by both methods, and once more as a tree that goes on from frame to frame. Labels,
trees and surfaces of each run get a hash of their own, so that a difference says what it is in.

Examples
--------
Before a change and after it::

    python benchmarks/answers.py recordings/demo.mcap FOLDER@525,525,319.5,239.5 --out before.txt
    python benchmarks/answers.py recordings/demo.mcap FOLDER@525,525,319.5,239.5 --against before.txt
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
from pathlib import Path

COMMAND = Path(sys.executable).with_name("nurbseg-live")
RUNS = {
    "nurbseg": ["--method", "nurbseg", "--temporal", "off"],
    "stag15": ["--method", "stag15", "--temporal", "off"],
    "live": ["--temporal", "on"],
}
FILES = {"labels": "*.png", "trees": "*_tree.json", "surfaces": "*.npz"}


def main() -> int:
    """Export, hash and compare; return 1 where answers differ."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="+", help="what nurbseg-live replays, with @FX,FY,CX,CY if needed")
    parser.add_argument("--frames", type=int, default=60, help="frames of each source (60)")
    parser.add_argument("--out", type=Path, help="write the hashes here")
    parser.add_argument("--against", type=Path, help="compare with these hashes")
    arguments = parser.parse_args()
    lines = [
        line
        for source in arguments.sources
        for run, options in RUNS.items()
        for line in hashes(source, run, [*options, "--frames", str(arguments.frames)])
    ]
    print("\n".join(lines))
    if arguments.out is not None:
        arguments.out.write_text("\n".join(lines) + "\n")
    if arguments.against is None:
        return 0
    before = arguments.against.read_text().splitlines()
    differing = sorted(set(lines) ^ set(before))
    for line in differing:
        print(f"differs: {line}")
    print(f"{len(set(lines) & set(before))} of {len(lines)} as before")
    return int(bool(differing))


def hashes(source: str, run: str, options: list[str]) -> list[str]:
    """Return a line for labels, trees and surfaces each: the hash, and what it is of."""
    recording, _, intrinsics = source.partition("@")
    if intrinsics:
        options = [*options, "--intrinsics", intrinsics]
    with tempfile.TemporaryDirectory() as folder:
        command = [COMMAND, "--quiet", "--replay", recording, "--speed", "0", "--view", "none"]
        subprocess.run([*command, "--export", folder, "--export-surfaces", *options], check=True)
        return [
            f"{hash_of(sorted(Path(folder).glob(pattern)))}  {Path(recording).name} {run} {kind}"
            for kind, pattern in FILES.items()
        ]


def hash_of(files: list[Path]) -> str:
    """Return the SHA-256 of the files' names and contents.

    Raises
    ------
    RuntimeError
        If there is no file: a hash of nothing never differs.
    """
    if not files:
        raise RuntimeError("the run exported no such file")
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    sys.exit(main())
