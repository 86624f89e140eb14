"""The process in which MATLAB files are read, as seen from here."""

from __future__ import annotations

import json
import math
import os
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.errors import BackendMissingError, FrameFormatError, quoted
from nurbseg.drivers.limits import FRAME_BYTES_MAX

#: Longest wait for an answer, seconds; the first comes after the libraries are loaded.
_ANSWER_S = 60.0
_HEAD_BYTES_MAX = 65_536


class MatProcess:
    """Reads MATLAB files; started on use, and again after a file that ended it."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None

    def read(
        self, path: Path, form: Literal["hdf5", "matlab5"], index: int | None = None
    ) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return what the program answers, and its arrays.

        Parameters
        ----------
        path : Path
            The file.
        form : {"hdf5", "matlab5"}
            The labelled set or a single frame.
        index : int, optional
            Frame of the labelled set; None asks for the shapes of the sets.

        Raises
        ------
        FrameFormatError
            If the file cannot be used, or has ended the process.
        BackendMissingError
            If a library that it needs is not installed.
        """
        child, requests, answers = self._running()
        request = {"path": str(path.absolute()), "form": form, "index": index}
        deadline_s = time.monotonic() + _ANSWER_S
        try:
            requests.write(json.dumps(request).encode() + b"\n")
            requests.flush()
            head, _, rest = _received(answers, b"", deadline_s, until_line=True).partition(b"\n")
            answer = json.loads(head)
            described = {
                name: (np.dtype(kind), tuple(shape)) for name, (kind, shape) in answer["arrays"].items()
            }
            sizes = [math.prod(shape) * kind.itemsize for kind, shape in described.values()]
            if sum(sizes) > 2 * FRAME_BYTES_MAX:
                raise FrameFormatError(f"{path}: expected {FRAME_BYTES_MAX} bytes at most, got {sum(sizes)}")
            content = _received(answers, rest, deadline_s, size=sum(sizes))
        except (OSError, TimeoutError, EOFError, FrameFormatError) as err:
            self.close()
            if isinstance(err, FrameFormatError):
                raise
            how = f"took over {_ANSWER_S:.0f} s" if isinstance(err, TimeoutError) else _end_of(child)
            raise FrameFormatError(f"{path}: cannot be read: the process that reads it {how}") from err
        if "missing" in answer:
            raise BackendMissingError(
                f"{path}: {answer['missing']} is needed to read it: pip install {answer['missing']}"
            )
        if "error" in answer:
            raise FrameFormatError(f"{path}: {quoted(answer['error'])[1:-1]}")
        arrays, place = {}, 0
        for (name, (kind, shape)), size in zip(described.items(), sizes, strict=True):
            arrays[name] = np.frombuffer(content, kind, math.prod(shape), place).reshape(shape)
            place += size
        return answer, arrays

    def close(self) -> None:
        """End the process; safe to call twice."""
        child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        child.wait()
        for pipe in (child.stdin, child.stdout):
            if pipe is not None:
                try:
                    pipe.close()
                except BrokenPipeError:
                    # What was not sent before it ended.
                    continue

    def _running(self) -> tuple[subprocess.Popen[bytes], IO[bytes], IO[bytes]]:
        if self._child is None:
            self._child = subprocess.Popen(
                [sys.executable, "-P", "-m", "nurbseg.drivers.datasets.mat_program"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                # Neither threads, which take address space, nor filters from anywhere.
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"},
            )
        requests, answers = self._child.stdin, self._child.stdout
        if requests is None or answers is None:
            raise OSError("the process has no pipes")
        return self._child, requests, answers


def _received(
    answers: IO[bytes],
    start: bytes | bytearray,
    deadline_s: float,
    *,
    size: int = 0,
    until_line: bool = False,
) -> bytearray:
    """Return an answer's bytes up to a number, or up to the end of a line and what came with it."""
    content = bytearray(start)
    while (b"\n" not in content) if until_line else (len(content) < size):
        left_s = deadline_s - time.monotonic()
        if left_s <= 0 or not select.select([answers], [], [], left_s)[0]:
            raise TimeoutError
        part = os.read(answers.fileno(), 1 << 20)
        if not part or (until_line and len(content) > _HEAD_BYTES_MAX):
            raise EOFError
        content += part
    return content


def _end_of(child: subprocess.Popen[bytes]) -> str:
    code = child.returncode
    return f"ended by signal {-code}" if code and code < 0 else f"ended with {code}"


__all__ = ["MatProcess"]
