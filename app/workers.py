"""Distributes tasks to processes of a Dask cluster or of this computer, which run this file as a program."""

import importlib
import logging
import pickle
import queue
import socket
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from nurbseg.common.process.child import (
    end_group,
    environment,
    exit_description,
    python_command,
    with_parent_death_signal,
)

Task = TypeVar("Task")
Result = TypeVar("Result")

#: Time limit of a task, seconds: a study may segment a frame with a hundred settings.
_TASK_LIMIT_S = 3600.0
#: Additional wait for a task that is executed twice, and wait for a cluster's first worker, seconds.
_SPARE_S, _WORKER_TIMEOUT_S = 10.0, 20.0
#: Longest wait for a scheduler's answer, seconds.
_SCHEDULER_TIMEOUT_S = 10.0
#: Time that a lost process has to end by itself, and the thread of one that has ended, seconds.
_EXIT_GRACE_S, _THREAD_END_S = 1.0, 5.0

#: A function to be executed of a task, and its future.
_Call = tuple[Future[Any], Callable[[Any], Any], Any]


class WorkerLostError(RuntimeError):
    """Two processes died while working on the same task."""


@dataclass(frozen=True, slots=True)
class Workers:
    """Executes tasks."""

    #: Executes a function of a task; the function is found by its name, and the task is copied.
    submit: Callable[[Callable[[Any], Any], Any], Future[Any]]
    #: Returns the number of tasks to submit in advance.
    ahead: Callable[[], int]


def in_order(
    workers: Workers, function: Callable[[Task], Result], tasks: Iterable[Task]
) -> Iterator[tuple[Task, Future[Result]]]:
    """Execute tasks, a limited number at a time, and yield each in its order with its future, which is done.

    The function must be one of a module. Raises WorkerLostError if there is no result for a long time.
    """
    pending: deque[tuple[Task, Future[Result]]] = deque()

    def finished() -> tuple[Task, Future[Result]]:
        if not wait([pending[0][1]], 2 * _TASK_LIMIT_S + _SPARE_S).done:
            raise WorkerLostError(f"no worker has answered within {2 * _TASK_LIMIT_S:g} s")
        return pending.popleft()

    try:
        for task in tasks:
            pending.append((task, workers.submit(function, task)))
            while pending and (len(pending) > workers.ahead() or pending[0][1].done()):
                yield finished()
        while pending:
            yield finished()
    finally:
        for _, future in pending:
            future.cancel()


@contextmanager
def open_workers(count: int, scheduler: str | None = None, *, module: str = "") -> Iterator[Workers]:
    """Provide workers until the block ends.

    These are `count` processes of this computer (1 for this process alone), or those of a Dask scheduler
    (``tcp://HOST:8786``), which must see the same files under the same names. Processes import `module`
    before their first task. Raises ValueError if the scheduler does not answer, or has no worker.
    """
    if scheduler is None and count == 1:
        yield Workers(_executed, lambda: 0)
        return
    with _processes(count, module) if scheduler is None else _cluster(scheduler) as workers:
        yield workers


def _executed(function: Callable[[Task], Result], task: Task) -> Future[Result]:
    future: Future[Result] = Future()
    try:
        future.set_result(function(task))
    except Exception as err:
        future.set_exception(err)
    return future


@contextmanager
def _processes(count: int, module: str) -> Iterator[Workers]:
    """Provide processes on this computer, each with a thread that waits for it.

    A signal can end the caller while it holds the lock of a future, which a thread then waits for in vain. So
    the threads are daemons, unlike those of `ThreadPoolExecutor`, and are waited for with a limit.
    """
    started: list[_Process] = []
    threads: list[threading.Thread] = []
    calls: queue.SimpleQueue[_Call | None] = queue.SimpleQueue()

    def submit(function: Callable[[Any], Any], task: Any) -> Future[Any]:
        future: Future[Any] = Future()
        calls.put((future, function, task))
        return future

    try:
        for number in range(count):
            started.append(_Process(module))
            words = started[-1], calls
            threads.append(
                threading.Thread(target=_execute, args=words, name=f"worker_{number}", daemon=True)
            )
            threads[-1].start()
        # One more for each, so that none waits for its next task.
        yield Workers(submit, lambda: 2 * count - 1)
    finally:
        for worker in started:
            worker.end()
            calls.put(None)
        for thread in threads:
            if thread.ident is not None:
                thread.join(_THREAD_END_S)
        for worker in started:
            worker.close()


def _execute(process: "_Process", calls: "queue.SimpleQueue[_Call | None]") -> None:
    """Have a process execute calls until there is None; those after its end fail at once."""
    while (call := calls.get()) is not None:
        future, function, task = call
        if not future.set_running_or_notify_cancel():
            continue
        try:
            result = process.call(function, task)
        except BaseException as err:
            future.set_exception(err)
        else:
            future.set_result(result)


class _Process:
    """A process that is replaced if it dies; called by one thread at a time."""

    def __init__(self, module: str) -> None:
        self._module = module
        self._lock = threading.Lock()
        self._closed = False
        self._start()

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        self._connection = Connection(ours.detach())
        with theirs:
            self._process = subprocess.Popen(
                with_parent_death_signal(
                    python_command("nurbseg.app.workers", str(theirs.fileno()), self._module)
                ),
                env=environment(),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                # Ctrl-C must reach this process only, which ends the others.
                start_new_session=True,
            )

    def call(self, function: Callable[[Task], Result], task: Task) -> Result:
        """Execute a task, once more if the process dies."""
        lost = ""
        for _ in range(2):
            try:
                self._connection.send((function, task))
                if not self._connection.poll(_TASK_LIMIT_S):
                    raise TimeoutError
                result, error = self._connection.recv()
            except (EOFError, OSError):
                with self._lock:
                    lost = exit_description(end_group(self._process, _EXIT_GRACE_S))
                    if self._closed:
                        break
                    self._connection.close()
                    self._start()
                continue
            if error is not None:
                raise error
            return result  # type: ignore[no-any-return]
        raise WorkerLostError(f"the process working on it {lost}, and so did another one")

    def end(self) -> None:
        """End the process for good; callable from any thread."""
        with self._lock:
            self._closed = True
            end_group(self._process, 0.0)

    def close(self) -> None:
        """Close the connection to the process, which has ended."""
        self._connection.close()


@contextmanager
def _cluster(scheduler: str) -> Iterator[Workers]:
    from distributed import Client

    try:
        client: Any = Client(scheduler, timeout=_SCHEDULER_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as err:
        raise ValueError(f"--scheduler {scheduler}: no Dask scheduler answers there ({err})") from err
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKER_TIMEOUT_S)
        except TimeoutError as err:
            raise ValueError(
                f"--scheduler {scheduler}: it has no workers; start some: dask worker {scheduler}"
            ) from err
        yield Workers(client.get_executor().submit, lambda: 2 * int(sum(client.ncores().values())))


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
