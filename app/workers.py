"""Distributes tasks to processes of a Dask cluster or of this computer, which run this file as a program."""

import importlib
import logging
import pickle
import queue
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from nurbseg.common.process import child

_log = logging.getLogger(__name__)

Task = TypeVar("Task")
Result = TypeVar("Result")

#: Time limit of a task, seconds: a study may segment a frame with a hundred settings.
_TASK_LIMIT_S = 3600.0
#: Additional wait for a task that is executed twice, and time that a lost process has to end, seconds.
_SPARE_S, _EXIT_GRACE_S = 10.0, 1.0
#: Longest waits for a scheduler's answer and for its first worker, seconds.
_SCHEDULER_TIMEOUT_S, _WORKER_TIMEOUT_S = 10.0, 20.0


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
    limit_s = 2 * _TASK_LIMIT_S + _SPARE_S

    def finished() -> tuple[Task, Future[Result]]:
        if not wait([pending[0][1]], limit_s).done:
            raise WorkerLostError(f"no worker has answered within {limit_s:g} s")
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
        yield Workers(lambda function, task: _execute(Future(), function, task), lambda: 0)
        return
    with _processes(count, module) if scheduler is None else _cluster(scheduler) as workers:
        yield workers


def _execute(future: Future[Result], function: Callable[[Task], Result], task: Task) -> Future[Result]:
    try:
        future.set_result(function(task))
    except Exception as err:
        future.set_exception(err)
    return future


@contextmanager
def _processes(count: int, module: str) -> Iterator[Workers]:
    """Provide processes on this computer, each with a thread that waits for it, and replaces it if it dies.

    A signal can end the caller while it holds the lock of a future, which a thread then waits for in vain. So
    the threads are daemons, unlike those of `ThreadPoolExecutor`.
    """
    calls: queue.SimpleQueue[tuple[Future[Any], Callable[[Any], Any], Any] | None] = queue.SimpleQueue()
    running: dict[int, tuple[subprocess.Popen[bytes], Connection]] = {}
    ended = threading.Event()

    def start(number: int) -> None:
        ours, theirs = Pipe()
        with theirs:
            words = child.python_command("nurbseg.app.workers", str(theirs.fileno()), module)
            process = subprocess.Popen(
                child.with_parent_death_signal(words),
                env=child.environment(),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                # Ctrl-C must reach this process only, which ends the others.
                start_new_session=True,
            )
        running[number] = process, ours
        if ended.is_set():
            child.end_group(process, 0.0)

    def call(number: int, function: Callable[[Any], Any], task: Any) -> Any:
        lost = ""
        for _ in range(2):
            process, connection = running[number]
            try:
                connection.send((function, task))
                if not connection.poll(_TASK_LIMIT_S):
                    raise TimeoutError
                result, error = connection.recv()
            except (EOFError, OSError):
                lost = child.exit_description(child.end_group(process, _EXIT_GRACE_S))
                if ended.is_set():
                    break
                _log.warning("a worker process %s; another one replaces it", lost)
                start(number)
                continue
            if error is not None:
                raise error
            return result
        raise WorkerLostError(f"the process working on it {lost}, and so did another one")

    def work(number: int) -> None:
        for future, function, task in iter(calls.get, None):
            if future.set_running_or_notify_cancel():
                _execute(future, partial(call, number, function), task)

    def submit(function: Callable[[Any], Any], task: Any) -> Future[Any]:
        future: Future[Any] = Future()
        calls.put((future, function, task))
        return future

    try:
        for number in range(count):
            start(number)
            threading.Thread(target=work, args=(number,), daemon=True).start()
        # One more for each, so that none waits for its next task.
        yield Workers(submit, lambda: 2 * count - 1)
    finally:
        ended.set()
        for process, _ in list(running.values()):
            child.end_group(process, 0.0)
            calls.put(None)


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


def _serve(descriptor: int, module: str) -> None:
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
                err.add_note(traceback.format_exc())
                answer = None, err
                try:
                    pickle.loads(pickle.dumps(err))
                except Exception:
                    answer = None, RuntimeError(f"{type(err).__name__}: {err}")
            calls.send(answer)


if __name__ == "__main__":
    _serve(int(sys.argv[1]), sys.argv[2])
