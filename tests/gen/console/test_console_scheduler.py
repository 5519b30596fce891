"""Work on other processes: the same bytes as made here, whoever is killed on the way, and one line where it fails."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest
import tiny

from rsgen.cli.main import main
from rsgen.config.config import Config, load_config
from rsgen.console import scheduler
from rsgen.console.scheduler import DaskWorkers, Workers, open_workers
from rsgen.errors import UserError
from rsgen.produce.generate import RenderJob, render_block, render_sequence
from rsgen.sequence.reader import read_sequence

FRAMES = 15  # 30 images, 4 blocks


def silent(*_: Any) -> None:
    pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scheduler")


@pytest.fixture(scope="module")
def here(folder: Path) -> dict[str, str]:
    """Digests of the sequence as this process makes it."""
    config = tiny.write_config(folder / "here", FRAMES, **NOISE)
    render_sequence(load_config(config), folder / "here/seq", slice(None), silent)
    return tiny.digests(folder / "here/seq")


@pytest.fixture(scope="module")
def config(folder: Path) -> Config:
    """The same sequence's config, of a scene whose light has not been baked."""
    return load_config(tiny.write_config(folder / "there", FRAMES, **NOISE))


@pytest.fixture(scope="module")
def workers() -> Iterator[DaskWorkers]:
    with open_workers("local:2") as workers:
        assert isinstance(workers, DaskWorkers)
        yield workers


# Noise has seeds of its own, and truth its own files.
NOISE = {"color": {"noise": {"model": "camera"}}, "depth": {"noise": {"model": "kinect"}}, "truth": {"normals": True}}


def kill_one_at_work(workers: DaskWorkers, when: Path, killed: list[int]) -> threading.Thread:
    """Once the file `when` is there, end the first worker process that has a job."""
    processes = workers.client.run(os.getpid)

    def wait_and_kill() -> None:
        while not killed:
            busy = [address for address, jobs in workers.client.processing().items() if jobs and when.exists()]
            for address in busy[:1]:
                os.kill(processes[address], signal.SIGKILL)
                killed.append(processes[address])
            time.sleep(0.01)

    thread = threading.Thread(target=wait_and_kill, daemon=True)
    thread.start()
    return thread


@pytest.mark.nightly
def test_a_killed_worker_changes_no_byte(
    here: dict[str, str], config: Config, workers: DaskWorkers, folder: Path
) -> None:
    out, stages = folder / "there/seq", list[str]()
    killed: list[int] = []
    thread = kill_one_at_work(workers, out / "rgb/000003.png", killed)
    render_sequence(config, out, slice(None), lambda stage, *_: stages.append(stage), workers)
    thread.join(timeout=10)
    assert killed and killed[0] not in workers.client.run(os.getpid).values()
    assert tiny.digests(out) == here
    # The light was baked on a worker, once, and kept for the others.
    assert stages[0] == "light" and "frames" in stages
    assert len(list((folder / "there/.rsgen-cache").glob("*.npz"))) == 1


def test_an_interrupted_run_is_readable_and_resumed_with_the_same_bytes(
    here: dict[str, str], config: Config, workers: DaskWorkers, tmp_path: Path
) -> None:
    def interrupt(stage: str, *_: Any) -> None:
        if stage == "frames":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_sequence(config, tmp_path / "seq", slice(None), interrupt, workers)
    assert 0 < len(read_sequence(tmp_path / "seq").streams["color"].paths) < FRAMES
    (tmp_path / "seq/truth/depth/000001.exr").unlink()
    render_sequence(config, tmp_path / "seq", slice(None), silent, workers)
    assert tiny.digests(tmp_path / "seq") == here


def square(job: int, progress: scheduler.Progress) -> int:
    if job < 0:
        raise UserError(f"{job}: is negative")
    progress("squares", 1.0, str(job))
    return job * job


def die(job: int, progress: scheduler.Progress) -> int:
    os._exit(job)


def wait_for(condition: Any) -> None:
    deadline = time.monotonic() + 10
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)


@pytest.mark.parametrize("remote", [False, True], ids=["here", "on workers"])
def test_every_job_is_done_once(remote: bool, workers: DaskWorkers, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "_LEAST_AHEAD", 2)
    monkeypatch.setattr(scheduler, "_AHEAD_PER_WORKER", 0)
    where, told = workers if remote else Workers(), []
    jobs = [3, 1, 2, 3, 5, 4]
    results = list(where.apply(square, jobs, lambda *what: told.append(what)))
    assert sorted(results) == [(i, job * job) for i, job in enumerate(jobs)]
    wait_for(lambda: len(told) == len(jobs))
    assert sorted(told) == sorted(("squares", 1.0, str(job)) for job in jobs)
    assert list(where.apply(square, [], silent)) == []
    with pytest.raises(UserError, match="-1: is negative"):
        list(where.apply(square, [1, -1], silent))


def render_threads(job: int, progress: scheduler.Progress) -> int:
    import drjit

    return drjit.thread_count()


def test_workers_of_this_machine_share_its_cores(workers: DaskWorkers) -> None:
    threads = [count for _, count in workers.apply(render_threads, range(4), silent)]
    assert threads == [max(1, len(os.sched_getaffinity(0)) // 2)] * 4


def test_a_job_that_ends_its_workers_is_given_up(workers: DaskWorkers) -> None:
    before = workers.client.run_on_scheduler(allow_failures, 0)
    try:
        with pytest.raises(UserError, match="local:2: 1 workers were lost with the same job") as caught:
            list(workers.apply(die, [3], silent))
    finally:
        workers.client.run_on_scheduler(allow_failures, before)
    assert "\n" not in str(caught.value) and before > 0
    assert list(workers.apply(square, [7], silent)) == [(0, 49)]


def allow_failures(count: int, dask_scheduler: Any) -> int:
    before, dask_scheduler.allowed_failures = dask_scheduler.allowed_failures, count
    return before


@pytest.fixture(scope="module")
def job(config: Config, tmp_path_factory: pytest.TempPathFactory) -> RenderJob:
    return tiny.render_job(config, tmp_path_factory.mktemp("sequence"), (0, "color"))


def test_a_worker_that_would_render_something_else_says_so(job: RenderJob, tmp_path: Path) -> None:
    def complaint(job: RenderJob) -> str:
        with pytest.raises(UserError) as caught:
            render_block(job, silent)
        return str(caught.value)

    config = job.writer.config
    assert "has mitsuba 3." in complaint(replace(job, versions=dict(job.versions) | {"mitsuba": "2.0"}))
    gone = config.scene.model_copy(update={"file": tmp_path / "scene.xml"})
    moved = replace(job, writer=replace(job.writer, config=config.model_copy(update={"scene": gone})))
    assert "scene.xml: is missing: workers need the scene at the same path" in complaint(moved)
    for name in ("scene.xml", "paper.png"):
        shutil.copy(config.scene.file.parent / name, tmp_path)
    (tmp_path / "scene.xml").write_text((tmp_path / "scene.xml").read_text().replace("0.7, 0.3, 0.2", "0.2, 0.3, 0.7"))
    assert "another one here" in complaint(moved)


def test_workers_are_reached_by_address(workers: DaskWorkers) -> None:
    with open_workers(workers.client.scheduler.address) as others:
        assert list(others.apply(square, [5], silent)) == [(0, 25)]


@pytest.mark.parametrize(
    ("on_worker", "on_scheduler", "text"),
    [
        ("0.0", "", "tcp://there:1 has version 0.0, not"),
        (PackageNotFoundError(), "", "tcp://there:1 lacks"),
        ("", "0.0", "its process has version 0.0, not"),
        ("", PackageNotFoundError(), "its process lacks"),
    ],
)
def test_workers_without_this_project_are_refused(on_worker: Any, on_scheduler: Any, text: str) -> None:
    class There:
        def run(self, ask: Any, name: str, on_error: str) -> dict[str, Any]:
            return {"tcp://here:1": ask(name), "tcp://there:1": on_worker or ask(name)}

        def run_on_scheduler(self, ask: Any, name: str) -> str:
            if isinstance(on_scheduler, Exception):
                raise on_scheduler
            return on_scheduler or ask(name)

    client: Any = There()
    with pytest.raises(UserError, match=text):
        scheduler._refuse_strangers(client, "tcp://it:8786")


@pytest.mark.parametrize("where", ["", "local:0", "local:x", "here", "tcp:", "host:port"])
def test_a_scheduler_that_is_none_is_refused(where: str) -> None:
    with pytest.raises(UserError, match="expected local, local:N or an address"), open_workers(where):
        pass


def test_a_scheduler_out_of_reach_is_said_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scheduler, "_CONNECT_S", 0.2)
    words = ["render", str(tiny.write_config(tmp_path)), "--out", str(tmp_path / "seq"), "--scheduler"]
    assert main([*words, "tcp://127.0.0.1:1"]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "tcp://127.0.0.1:1: cannot be reached" in error
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main([*words, "local"]) == 2
    assert "pip install" in capfd.readouterr().err
    assert not (tmp_path / "seq").exists()
