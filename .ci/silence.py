"""Runs a command, however long it takes, but ends it when it has printed nothing for so many seconds.

Usage: python .ci/silence.py SECONDS COMMAND...; the exit code is the command's, or 124 if it was silent.
"""

import os
import select
import signal
import subprocess
import sys
import time

#: Time that a silent command has to report and end after Ctrl-C, seconds, before it is killed.
_END_S = 30.0
#: Time between two looks at whether the command has ended, seconds.
_POLL_S = 1.0
SILENT = 124


def main(limit_s: float, command: list[str]) -> int:
    """Run the command, pass its output on, and return its exit code."""
    colors = {"FORCE_COLOR": "1"} if sys.stdout.isatty() else {}
    # A process group of its own, all of which is ended.
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, **colors},
        process_group=0,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: os.killpg(process.pid, number))
    if ends_before_silence(process, limit_s):
        code = process.wait()
        return code if code >= 0 else 128 - code
    print(f"\n{command[0]}: no output for {limit_s:g} s: ended", flush=True)
    os.killpg(process.pid, signal.SIGINT)
    if not ends_before_silence(process, _END_S):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return SILENT


def ends_before_silence(process: subprocess.Popen[bytes], limit_s: float) -> bool:
    """Copy output until the process ends; return False when there was none for too long."""
    output = process.stdout.fileno()
    heard_s = time.monotonic()
    while time.monotonic() - heard_s < limit_s:
        if select.select([output], [], [], min(_POLL_S, limit_s))[0]:
            content = os.read(output, 65536)
            if not content:
                return True
            sys.stdout.buffer.write(content)
            sys.stdout.buffer.flush()
            heard_s = time.monotonic()
        elif process.poll() is not None:
            return True  # What it started may still hold its output.
    return False


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]), sys.argv[2:]))
