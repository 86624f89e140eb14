import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future
from multiprocessing import Pipe
from pathlib import Path

import psutil
import pytest
from own_children import own_children
from worker_tasks import die_at_2, fail_at_1, is_imported, named, process_of, raise_unsendable, sleep_if

from nurbseg.app.workers import WorkerLostError, Workers, in_order, open_workers
from nurbseg.common.computer import process_count

FAKES = str(Path(__file__).parents[1] / "fakes")


@pytest.fixture(autouse=True)
def found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes find what they are given to do."""
    monkeypatch.setenv("PYTHONPATH", FAKES)


@pytest.fixture
def two() -> Iterator[Workers]:
    with open_workers(2) as workers:
        yield workers


def test_results_come_in_the_order_of_their_tasks(two: Workers, tmp_path: Path) -> None:
    tasks = [(name, tmp_path) for name in ("first", "second", "third")]
    done = [(task, future.result()) for task, future in in_order(two, named, tasks)]
    assert done == [(task, task[0]) for task in tasks]


def test_tasks_are_taken_as_there_is_room_for_them(two: Workers) -> None:
    taken: list[int] = []

    def tasks() -> Iterator[int]:
        for number in range(40):
            taken.append(number)
            yield number

    for number, future in in_order(two, process_of, tasks()):
        assert future.done()
        assert len(taken) <= number + 4
    assert taken == list(range(40))


def test_one_worker_is_this_process() -> None:
    with open_workers(1) as workers:
        assert [future.result() for _, future in in_order(workers, process_of, range(2))] == 2 * [os.getpid()]


def test_two_workers_are_two_others(two: Workers) -> None:
    found = {future.result() for _, future in in_order(two, process_of, range(20))}
    assert os.getpid() not in found
    assert len(found) == 2


def test_auto_is_a_process_for_each_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {1, 4, 5})
    assert [process_count("auto"), process_count(2)] == [3, 2]


def test_processes_have_imported_a_module_before_their_first_task() -> None:
    for module, is_there in (("wave", True), ("", False)):
        with open_workers(2, module=module) as workers:
            assert workers.submit(is_imported, "wave").result() is is_there


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_is_that_of_its_task_alone(count: int) -> None:
    with open_workers(count) as workers:
        futures = [future for _, future in in_order(workers, fail_at_1, range(3))]
    assert [futures[0].result(), futures[2].result()] == [0, 2]
    with pytest.raises(FileNotFoundError, match=r"gone: 'frame\.png'"):
        futures[1].result()


def test_an_error_that_cannot_be_sent_keeps_its_words(two: Workers) -> None:
    [(_, future)] = in_order(two, raise_unsendable, [0])
    with pytest.raises(RuntimeError, match="UnsendableError: torn apart"):
        future.result()


def test_a_lost_process_is_named_and_replaced_and_its_task_done_again(
    two: Workers, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tasks = [(number, tmp_path, 1) for number in range(6)]
    assert [future.result() for _, future in in_order(two, die_at_2, tasks)] == list(range(6))
    assert len(list(tmp_path.iterdir())) == 1
    assert caplog.messages == ["a worker process ended by signal 9; another one replaces it"]


def test_a_task_that_ends_two_processes_is_given_up_alone(two: Workers, tmp_path: Path) -> None:
    tasks = [(number, tmp_path, 9) for number in range(6)]
    futures = [future for _, future in in_order(two, die_at_2, tasks)]
    with pytest.raises(WorkerLostError, match="ended by signal 9, and so did another one"):
        futures.pop(2).result()
    assert [future.result() for future in futures] == [0, 1, 3, 4, 5]
    assert len(list(tmp_path.iterdir())) == 2


def test_a_task_that_takes_longer_than_the_limit_is_tried_once_more_and_given_up(
    two: Workers, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert two.submit(sleep_if, 0).result() == 0
    before = set(own_children())
    with monkeypatch.context() as patches:
        patches.setattr("nurbseg.app.workers._TASK_LIMIT_S", 1.0)
        (_, future) = next(in_order(two, sleep_if, [1]))
    with pytest.raises(WorkerLostError, match=r"the process working on it .*, and so did another one"):
        future.result()
    # One of the two has been replaced, and what replaced it, too.
    assert len(before - set(own_children())) == 1
    assert two.submit(sleep_if, 0).result() == 0


def test_workers_that_never_answer_are_not_waited_for_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nurbseg.app.workers._TASK_LIMIT_S", 0.2)
    monkeypatch.setattr("nurbseg.app.workers._SPARE_S", 0.1)
    given: list[Future[int]] = []

    def submit(function: object, task: object) -> Future[int]:
        given.append(Future())
        return given[-1]

    with pytest.raises(WorkerLostError, match=r"no worker has answered within 0\.5 s"):
        next(in_order(Workers(submit, lambda: 1), process_of, range(9)))
    # Nor is any of what was to be done next begun after that.
    assert [each.cancelled() for each in given] == [True, True]


def test_an_address_without_a_scheduler_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("nurbseg.app.workers._SCHEDULER_TIMEOUT_S", 0.2)
    said = r"^--scheduler tcp://127\.0\.0\.1:9: no Dask scheduler answers there"
    with pytest.raises(ValueError, match=said), open_workers(1, "tcp://127.0.0.1:9"):
        pass


@pytest.mark.filterwarnings("default")
def test_a_cluster_is_given_two_tasks_for_each_of_its_threads() -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=3, processes=False, dashboard_address=None, protocol="tcp"
        ) as cluster,
        open_workers(1, cluster.scheduler_address) as workers,
    ):
        assert workers.ahead() == 6
        # Its worker is a thread of this process.
        assert [future.result() for _, future in in_order(workers, process_of, range(8))] == 8 * [os.getpid()]


def test_leaving_ends_processes_whatever_they_are_doing() -> None:
    before = set(own_children())
    with open_workers(2) as workers:
        tasks = in_order(workers, sleep_if, [0, 1])
        assert next(tasks)[1].result() == 0
        tasks.close()
    assert set(own_children()) == before


def test_a_signal_that_comes_while_a_future_is_looked_at_does_not_keep_the_program_from_ending() -> None:
    # Then the lock of the future is never given back, and the thread that is to set it waits for that.
    program = """
import time
from nurbseg.app.workers import open_workers
try:
    with open_workers(2) as workers:
        future = workers.submit(time.sleep, 60.0)
        future._condition.acquire()
        raise KeyboardInterrupt
except KeyboardInterrupt:
    print("ended")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "ended\n"), done.stderr


@pytest.mark.parametrize("tasks", [0, 1], ids=["while-waiting", "while-working"])
def test_a_process_whose_parent_has_ended_ends_without_an_error(tasks: int) -> None:
    parent, child = Pipe()
    for task in range(tasks):
        parent.send((process_of, task))
    parent.close()
    words = [sys.executable, "-m", "nurbseg.app.workers", str(child.fileno()), ""]
    done = subprocess.run(words, pass_fds=[child.fileno()], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_processes_end_with_the_one_that_started_them(tmp_path: Path) -> None:
    said = tmp_path / "said"
    code = f"import worker_tasks; worker_tasks.start_and_tell({str(said)!r})"
    parent = psutil.Popen([sys.executable, "-c", code])
    try:
        limit_s = time.monotonic() + 120
        while not (said.exists() and said.read_text()):
            assert parent.poll() is None and time.monotonic() < limit_s
            time.sleep(0.02)
        children = parent.children()
    finally:
        parent.kill()
        parent.wait(10)
    assert len(children) >= 2
    _, alive = psutil.wait_procs(children, timeout=60)
    for each in alive:
        each.kill()
    assert alive == []
