"""The program of a worker process of `nurbseg.app.workers`."""

import importlib
import logging
import pickle
import sys
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any


def serve(descriptor: int, module: str) -> None:
    """Import a module, if named; execute the calls that arrive through a connection until its end."""
    # The process that started this one reads each recording as well, and says what is wrong with it.
    logging.getLogger("nurbseg").addHandler(logging.NullHandler())
    calls = Connection(descriptor)
    if module:
        importlib.import_module(module)
    with suppress(EOFError, ConnectionError):
        while True:
            function, task = calls.recv()
            answer: tuple[Any, Exception | None]
            try:
                answer = function(task), None
            except Exception as err:
                answer = None, _sendable(err)
            calls.send(answer)


def _sendable(err: Exception) -> Exception:
    err.add_note(traceback.format_exc())
    try:
        pickle.loads(pickle.dumps(err))
    except Exception:
        return RuntimeError(f"{type(err).__name__}: {err}")
    return err


if __name__ == "__main__":
    serve(int(sys.argv[1]), sys.argv[2])
