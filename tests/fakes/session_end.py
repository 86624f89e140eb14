"""Lets a test session end though a test left a thread that is stuck, in Python or in a library."""

from __future__ import annotations

import faulthandler
import os
import sys
import threading

import pytest

#: How long leaving threads may take, and the interpreter's own end, seconds.
_GRACE_S, _END_LIMIT_S = 2.0, 60.0
_status = pytest.StashKey[int]()


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    session.config.stash[_status] = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """End the process by force where it would not end by itself; the summary has been printed."""
    threads = [
        each for each in threading.enumerate() if each is not threading.current_thread() and not each.daemon
    ]
    for thread in threads:
        thread.join(_GRACE_S)
    stuck = [thread.name for thread in threads if thread.is_alive()]
    if stuck and _status in config.stash:
        print(f"ended by force, threads still run: {', '.join(stuck)}", flush=True)
        sys.stderr.flush()
        os._exit(config.stash[_status])
    is_worker = hasattr(config, "workerinput")  # waits for the others, and is ended by the first process
    if sys.__stderr__ is not None and not is_worker:
        # Others may be stuck in a library: Rerun's can hold up the interpreter's end for good.
        faulthandler.dump_traceback_later(_END_LIMIT_S, exit=True, file=sys.__stderr__)


__all__ = ["pytest_sessionfinish", "pytest_unconfigure"]
