"""Jobs run here, in processes of this machine or on a cluster (Dask): the same results wherever they are made."""

from __future__ import annotations

import functools
import logging
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Annotated, Any, TypeVar
from uuid import uuid4

from rsgen.console.progress import Progress
from rsgen.errors import UserError, how_to_install

if TYPE_CHECKING:
    from distributed import Client

log = logging.getLogger("rsgen")

Job = TypeVar("Job")
Result = TypeVar("Result")

Scheduler = Annotated[
    str | None,
    "where to work: the address of a Dask scheduler (tcp://HOST:8786), 'local' for a process on every core of this "
    "machine, or 'local:N' for N processes (default: this process alone)",
    "ADDRESS|local[:N]",
]
_CONNECT_S = 10
# Tells a worker of this machine how many threads it may use.
_THREADS = "RSGEN_WORKER_THREADS"
_PACKAGE = "rolling-shutter-rgbd"
# Jobs that a scheduler holds for us at a time, so that their results cannot pile up here; many enough for a cluster
# that grows with what waits.
_LEAST_AHEAD = 64
_AHEAD_PER_WORKER = 4
# Workers that may die of one job on this machine before it counts as the job's own fault.
_ALLOWED_FAILURES = 5


class Workers:
    """What runs jobs, opened with `open_workers`: these here, in order."""

    def apply(
        self, function: Callable[[Job, Progress], Result], jobs: Sequence[Job], progress: Progress
    ) -> Iterator[tuple[int, Result]]:
        """Yield (i, function(jobs[i], progress)) as they come, in any order.

        Function, jobs and results are pickled: a function of a module, plain data. A job may run more than once, on
        another worker, if the first one is lost. All jobs of a process run in one thread, one after the other. What a
        job tells `progress` arrives at the caller's, from another thread. Raises what a job raises, and UserError if
        the scheduler or again and again a job's worker is lost.
        """
        for index, job in enumerate(jobs):
            yield index, function(job, progress)


class DaskWorkers(Workers):
    """Runs jobs on the workers of a Dask scheduler; `client` is connected to it."""

    def __init__(self, client: Client, name: str) -> None:
        self.client = client
        self.name = name

    def apply(
        self, function: Callable[[Job, Progress], Result], jobs: Sequence[Job], progress: Progress
    ) -> Iterator[tuple[int, Result]]:
        """See `Workers`."""
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        if not self.client.nthreads():
            log.info("scheduler %s has no workers yet: waiting for the first", self.name)
        topic = f"rsgen-{uuid4().hex}"
        run = functools.partial(_run, function, topic)
        waiting = enumerate(jobs)
        numbers: dict[str, int] = {}
        done = as_completed([], loop=self.client.loop, with_results=True)

        def submit() -> None:
            for index, job in waiting:
                # The key has to be new: an equal job of an earlier call may have left other results behind.
                key = f"{getattr(function, '__name__', 'job')}-{uuid4().hex}"
                numbers[key] = index
                done.add(self.client.submit(run, job, key=key, pure=False))
                return

        self.client.subscribe_topic(topic, lambda event: progress(*event[1]))
        try:
            ahead = max(_LEAST_AHEAD, _AHEAD_PER_WORKER * sum(self.client.nthreads().values()))
            for _ in range(ahead):
                submit()
            for future, result in done:
                if future.cancelled():  # by Dask, when it no longer sees the scheduler
                    raise UserError(
                        f"scheduler {self.name}: was lost: start it again, then run the same command again to resume"
                    )
                submit()
                index = numbers.pop(future.key)
                future.release()
                yield index, result
        except KilledWorker as error:
            raise UserError(
                f"scheduler {self.name}: {error.allowed_failures + 1} workers were lost with the same job, the last "
                f"was {error.last_worker.address}: give workers more memory, or more lives with "
                "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES, then run the same command again to resume"
            ) from None
        finally:
            self.client.unsubscribe_topic(topic)


@contextmanager
def open_workers(where: str | None) -> Iterator[Workers]:
    """The workers that `--scheduler` names, until the block ends.

    where: None for this process, 'local' or 'local:N' for processes of this machine, else a Dask scheduler's address.
    Raises UserError if it is none of these or cannot be reached, or if Dask is not installed.
    """
    if where is None:
        yield Workers()
        return
    local = re.fullmatch(r"local(?::([1-9]\d{0,3}))?", where)
    if local is None and not re.fullmatch(r"[a-z]+://\S+|(?!local:)[^\s:/]+:\d+", where):
        raise UserError(f"--scheduler {where}: expected local, local:N or an address such as tcp://host:8786")
    try:
        import distributed  # noqa: F401 - here to say so in one line
    except ImportError:
        raise UserError(f"--scheduler needs Dask: {how_to_install('cluster')}") from None
    _let_dask_log(logging.WARNING)
    with _connected(where) if local is None else _started(int(local[1] or _cores())) as client:
        try:
            yield DaskWorkers(client, where)
        finally:
            # What is cut off when unfinished work is given up is no news.
            _let_dask_log(logging.CRITICAL)


def _let_dask_log(level: int) -> None:
    for name in ("distributed", "distributed.client"):  # Dask gives the second one a level of its own
        logging.getLogger(name).setLevel(level)


@contextmanager
def _started(count: int) -> Iterator[Client]:
    import dask
    from distributed import Client, LocalCluster

    settings = {"distributed.scheduler.allowed-failures": _ALLOWED_FAILURES}
    with (
        dask.config.set(settings),
        # No limit of memory: Dask's default divides the machine's by the number of workers and kills what needs more.
        LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, memory_limit=None,
            dashboard_address="127.0.0.1:0", preload=[__name__], env={_THREADS: max(1, _cores() // count)},
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):  # fmt: skip
        yield client


@contextmanager
def _connected(address: str) -> Iterator[Client]:
    from distributed import Client

    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"--scheduler {address}: cannot be reached ({reason}): is it running, and at this address?"
        ) from None
    with client:
        _refuse_strangers(client, address)
        yield client


def _refuse_strangers(client: Client, address: str) -> None:
    """Raises UserError if the scheduler or a worker has not this project: it would break off without a word."""
    mine = version(_PACKAGE)
    theirs: dict[str, Any] = client.run(version, _PACKAGE, on_error="return")
    try:
        theirs["its process"] = client.run_on_scheduler(version, _PACKAGE)
    except PackageNotFoundError as error:
        theirs["its process"] = error
    for who, other in theirs.items():
        if other != mine:
            has = f"has version {other}, not {mine}, of" if isinstance(other, str) else "lacks"
            raise UserError(f"--scheduler {address}: {who} {has} {_PACKAGE}: install the same as here")


def dask_setup(worker: Any) -> None:
    """Called by Dask in every new worker of this machine: Ctrl-C and errors are for the process the user started."""
    _let_dask_log(logging.ERROR)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run(function: Callable[[Any, Progress], Any], topic: str, job: Any) -> Any:
    """On a worker: the job, in the one thread of this process that may use a renderer."""
    from distributed import get_worker

    worker = get_worker()
    return _thread().submit(_run_alone, function, job, lambda *what: worker.log_event(topic, what)).result()


def _run_alone(function: Callable[[Any, Progress], Any], job: Any, progress: Progress) -> Any:
    _share_cores()
    return function(job, progress)


@functools.cache
def _share_cores() -> None:
    """Leave the other workers of this machine their cores: Dr.Jit would take them all in each."""
    if _THREADS in os.environ:
        from rsgen.device.backend import select

        select()
        import drjit

        drjit.set_thread_count(int(os.environ[_THREADS]))


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def _thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1)
