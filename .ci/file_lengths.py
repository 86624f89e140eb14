"""Names Python files of more than 450 lines, tests apart: they have a second subject; exits with 1 then."""

import subprocess
import sys
from pathlib import Path

LINES_MAX = 450


def main(names: list[str]) -> int:
    """Check the files named, or all that git knows."""
    if not names:
        listing = subprocess.run(["git", "ls-files", "*.py"], capture_output=True, text=True, check=True)
        names = listing.stdout.splitlines()
    too_long = 0
    for name in (name for name in names if not name.startswith("tests/")):
        lines = len(Path(name).read_text(encoding="utf-8").splitlines()) if Path(name).exists() else 0
        if lines > LINES_MAX:
            print(f"{name}: {lines} lines, {LINES_MAX} at most: which is its second subject?")
            too_long += 1
    return int(too_long > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
