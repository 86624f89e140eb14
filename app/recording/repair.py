"""Writes a complete copy of a truncated or damaged recording."""

import errno
import shutil
from pathlib import Path

from nurbseg.app.recording import viewer_file
from nurbseg.app.recording.inspection import form_of
from nurbseg.app.recording.viewer_file import WriteError
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.files import check_absent, create_private
from nurbseg.drivers.mcap.writer import rewrite
from nurbseg.drivers.openni2.oni.file import correct_header, write_end

#: Of a disk or a quota that is full, and of a file that must not grow.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def repair(path: Path, output: Path, *, force: bool = False) -> list[str]:
    """Write the readable part of a recording to a new file; return remarks on what was left out.

    The new file appears when it is complete, and only this user may read it. `force` replaces an existing
    file, even `path` itself. Raises DriverError if nothing can be read, or the new file exists or cannot be
    created, and WriteError if the disk is full.
    """
    write = {"mcap": _write_mcap, "oni": _write_oni, "rrd": viewer_file.rewrite}[form_of(path)]
    part = output.with_name(f".{output.name}.part")
    try:
        if not force:
            check_absent(output)
        part.unlink(missing_ok=True)
        try:
            damaged = write(path, part)
            part.replace(output)
        finally:
            part.unlink(missing_ok=True)
    except OSError as err:
        advice = ", or overwrite it with --force" if isinstance(err, FileExistsError) else ""
        kind = WriteError if err.errno in _FULL else DriverError
        raise kind(f"{output}: cannot be written: {err.strerror}{advice}") from err
    return [f"damaged parts of {path} that were left out: {damaged}"] if damaged else []


def _write_mcap(path: Path, part: Path) -> int:
    with create_private(part) as file:
        return rewrite(path, file)


def _write_oni(path: Path, part: Path) -> None:
    with create_private(part) as file, path.open("rb") as source:
        shutil.copyfileobj(source, file, 1 << 20)
    correct_header(part)
    write_end(part)
