"""Distributes tasks to processes of this computer or of a Dask cluster."""

import os
import queue
import socket
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, Literal, Protocol, TypeVar

from nurbseg.drivers.process.child import dying_with_parent, end_group, how_it_ended, python_command

Task = TypeVar("Task")
Result = TypeVar("Result")

#: Time limit of a task, seconds: a study may segment a frame with a hundred settings.
_TASK_LIMIT_S = 3600.0
#: Additional wait for a task that is executed twice, and wait for a cluster's first worker, seconds.
_SPARE_S, _WORKER_TIMEOUT_S = 10.0, 20.0
#: Longest wait for a scheduler's answer, seconds.
_SCHEDULER_TIMEOUT_S = 10.0
#: Time that a lost process has to end by itself, seconds.
_LAST_WORDS_S = 1.0


class WorkerLostError(RuntimeError):
    """Two processes died while working on the same task."""


class Workers(Protocol):
    """Executes tasks."""

    def submit(self, function: Callable[[Task], Result], task: Task, /) -> Future[Result]:
        """Execute a task; `function` is found by its name, and the task is copied."""
        ...

    def ahead(self) -> int:
        """Return the number of tasks to submit in advance."""
        ...


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


def process_count(workers: int | Literal["auto"]) -> int:
    """Return the number of processes that a setting asks for."""
    return len(os.sched_getaffinity(0)) if workers == "auto" else workers


@contextmanager
def open_workers(count: int, scheduler: str | None = None, *, module: str = "") -> Iterator[Workers]:
    """Provide workers until the block ends.

    These are `count` processes of this computer (1 for this process alone), or those of a Dask scheduler
    (``tcp://HOST:8786``), which must see the same files under the same names. Processes import `module`
    before their first task. Raises ValueError if the scheduler does not answer, or has no worker.
    """
    if scheduler is not None:
        with _cluster(scheduler) as cluster:
            yield cluster
    elif count == 1:
        yield _ThisProcess()
    else:
        processes = _Processes(count, module)
        try:
            yield processes
        finally:
            processes.close()


class _ThisProcess:
    """Executes a task when it is submitted."""

    def submit(self, function: Callable[[Task], Result], task: Task, /) -> Future[Result]:
        future: Future[Result] = Future()
        try:
            future.set_result(function(task))
        except Exception as err:
            future.set_exception(err)
        return future

    def ahead(self) -> int:
        return 0


class _Processes:
    """Processes on this computer, each with a thread that waits for it."""

    def __init__(self, count: int, module: str) -> None:
        self._count = count
        self._idle: queue.SimpleQueue[_Process] = queue.SimpleQueue()
        self._all: list[_Process] = []
        self._threads = ThreadPoolExecutor(count, "worker")
        try:
            for _ in range(count):
                self._all.append(_Process(module))
                self._idle.put(self._all[-1])
        except BaseException:
            self.close()
            raise

    def submit(self, function: Callable[[Task], Result], task: Task, /) -> Future[Result]:
        return self._threads.submit(self._done, function, task)

    def ahead(self) -> int:
        # One more for each, so that none waits for its next task.
        return 2 * self._count - 1

    def _done(self, function: Callable[[Task], Result], task: Task) -> Result:
        process = self._idle.get_nowait()  # there are as many threads as processes
        try:
            return process.call(function, task)
        finally:
            self._idle.put(process)

    def close(self) -> None:
        """End all processes at once."""
        for each in self._all:
            each.end()
        self._threads.shutdown(cancel_futures=True)
        for each in self._all:
            each.close()


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
                dying_with_parent(python_command("nurbseg.app.worker", str(theirs.fileno()), self._module)),
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
                    lost = self._end(_LAST_WORDS_S)
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
            self._end(0.0)

    def close(self) -> None:
        """Close the connection to the process, which has ended."""
        self._connection.close()

    def _end(self, limit_s: float) -> str:
        """Wait for the end of the process, or kill it; return how it ended."""
        return how_it_ended(end_group(self._process, limit_s))


class _Cluster:
    """The workers of a Dask scheduler."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._executor = client.get_executor()

    def submit(self, function: Callable[[Task], Result], task: Task, /) -> Future[Result]:
        return self._executor.submit(function, task)  # type: ignore[no-any-return]

    def ahead(self) -> int:
        return 2 * int(sum(self._client.ncores().values()))


@contextmanager
def _cluster(scheduler: str) -> Iterator[_Cluster]:
    from distributed import Client

    try:
        client = Client(scheduler, timeout=_SCHEDULER_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as err:
        raise ValueError(f"--scheduler {scheduler}: no Dask scheduler answers there ({err})") from err
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKER_TIMEOUT_S)
        except TimeoutError as err:
            raise ValueError(
                f"--scheduler {scheduler}: it has no workers; start some: dask worker {scheduler}"
            ) from err
        yield _Cluster(client)
