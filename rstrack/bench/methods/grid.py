"""The grid of `rstrack bench`: every method on every sequence, each cell a folder that is kept for the next time.

plan = make_plan(choose(load_bench_config(Path("configs/evaluation.yaml"))), Path("out"), Path("out/bench"))
results = run_plan(plan)
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.progress import Progress, no_progress
from rsgen.console.scheduler import InProcess, Workers
from rsgen.errors import UserError
from rsgen.files import atomic_write, read_text
from rstrack.bench.methods.plan import Job, Plan, package_version
from rstrack.bench.methods.results import Cell, Results
from rstrack.bench.methods.variants import method_of
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import TRAJECTORY, Estimate, plain, read_estimate, write_estimate
from rstrack.data.noise import NoisyImages
from rstrack.metrics.association import ASSOCIATE_WITHIN_S, truth_of
from rstrack.metrics.evaluate import Metrics, evaluate
from rstrack.metrics.run_evaluate import evaluate_clocks
from rstrack.options import CLOUD_PEERS, METHODS, SLAM_PEERS
from rstrack.peers.command import run_command
from rstrack.tracking.runs.record import Noise
from rstrack.tracking.runs.run import track

CELL = "cell.json"


def run_plan(plan: Plan, workers: Workers | None = None, progress: Progress = no_progress) -> Results:
    """Run the cells that are not there yet, in this process or by `workers`, and gather all of them.

    Ctrl-C ends it early: the results hold what is finished. Raises UserError if a folder cannot be written, or is not
    shared with the workers.
    """
    cells = {job: cell for job in plan.jobs if (cell := read_cell(job)) is not None}
    todo = [job for job in plan.jobs if job not in cells]
    running: dict[str, float] = {}
    interrupted = False

    def report(name: str, fraction: float, note: str) -> None:
        running[name] = fraction
        done = (len(cells) + sum(tuple(running.values()))) / len(plan.jobs)
        # What workers tell may arrive after their cell.
        progress("cells", min(done, 1.0), f"{name}, {note}")

    try:
        for k, cell in (workers or InProcess()).apply(run_cell, todo, report):
            job = todo[k]
            if cell.error is None and read_cell(job) is None:
                raise UserError(f"{job.out}: a worker has written it, but not here: choose an --out that all share")
            cells[job] = cell
            running.pop(_name(job), None)
            progress("cells", len(cells) / len(plan.jobs), f"{_name(job)} done")
    except KeyboardInterrupt:
        interrupted = True
    ordered = tuple(cells[job] for job in plan.jobs if job in cells)
    return Results(plan.sequences, plan.methods, ordered, machine(), package_version(), interrupted)


def run_cell(job: Job, progress: Progress = no_progress) -> Cell:
    """Track, evaluate, and write the cell's folder: a run as `rstrack track` writes it, and cell.json.

    A track that was lost is a cell as any other, and kept. Where something is missing or cannot be read, the cell says
    so and is tried again the next time. Of a trajectory that is there already only the errors are computed. progress:
    its stage is 'SEQUENCE METHOD'. Raises KeyboardInterrupt, and UserError if the folder cannot be written.
    """
    cell_file = job.out / CELL
    frames = job.last - job.first
    make = partial(Cell, job.key, job.sequence, job.method, frames=frames, truth_offset=job.truth_offset)
    there = _read(job)
    try:
        dataset = _seen(open_dataset(job.data), job.noise)
        if there is not None:
            estimate, seconds = read_estimate(job.out), there.seconds
        else:
            cell_file.unlink(missing_ok=True)
            estimate, seconds = _estimate(job, dataset, lambda _, fraction, note: progress(_name(job), fraction, note))
    except UserError as error:
        return make(metrics=None, lost=frames, seconds=None, error=str(error))
    metrics, offset_s = _metrics(job, dataset, estimate)
    lost = frames if metrics is None else metrics.frames - metrics.frames_tracked
    found = None if metrics is None else metrics.as_dict()
    cell = make(metrics=found, lost=lost, seconds=seconds, truth_offset_s=offset_s)
    atomic_write(cell_file, (json.dumps(plain(dataclasses.asdict(cell)), indent=1) + "\n").encode())
    return cell


def read_cell(job: Job) -> Cell | None:
    """The finished cell of a job, None if there is none, or one of other inputs."""
    cell = _read(job)
    return cell if cell is not None and cell.truth_offset == job.truth_offset else None


def machine() -> dict[str, Any]:
    """What the figures' times were taken on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    cpu = models[0] if models else platform.processor() or platform.machine()
    return {
        "cpu": cpu,
        "cpu_count": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
    }


# ---------------------------------------------------------------------------------------------------------------------


def _read(job: Job) -> Cell | None:
    """The cell with the job's trajectory, whichever the truth's clock was; None if there is none."""
    try:
        cell = Cell(**json.loads(read_text(job.out / CELL)))
    except (UserError, ValueError, TypeError, RecursionError):
        return None
    return cell if cell.key == job.key and (job.out / TRAJECTORY).is_file() else None


def _name(job: Job) -> str:
    return f"{job.sequence} {job.method}"


def _seen(dataset: Dataset, noise: Noise | None) -> Dataset:
    """The dataset with noise in its images, the same that our trackers add themselves (and note in run.json)."""
    if noise is None:
        return dataset
    noisy = NoisyImages(dataset.images, noise.sigma_depth, noise.sigma_intensity, noise.seed)
    return dataclasses.replace(dataset, images=noisy)


def _estimate(job: Job, dataset: Dataset, progress: Progress) -> tuple[Estimate, float | None]:
    """The trajectory, written to the cell's folder, and the seconds that it took. Raises UserError."""
    frames = slice(job.first, job.last)
    if method_of(job.method) in METHODS:
        result = track(open_dataset(job.data), job.options, job.out, frames, job.noise, progress)
        if result.end == "interrupted":
            raise KeyboardInterrupt
        if result.unreadable:
            raise UserError(result.unreadable[0])
        return result.estimate, result.estimate.info["timings"]["total_s"]
    seconds = None
    if job.estimate is not None:
        estimate = _cut(read_estimate(job.estimate), dataset.stamps[frames])
    else:
        begin = time.perf_counter()
        if job.command:
            progress(job.method, 0.0, "its command runs")
            estimate = _cut(run_command(job.method, job.command, dataset.root, job.out), dataset.stamps[frames])
        elif job.method in CLOUD_PEERS:
            from rstrack.peers.clouds import run_cloud_peer

            estimate = run_cloud_peer(job.method, dataset, frames, progress)
        elif job.method in SLAM_PEERS:
            from rstrack.peers.orb_slam3 import run_orb_slam3

            estimate = run_orb_slam3(dataset, frames, progress, seed=0 if job.noise is None else job.noise.seed)
        else:
            from rstrack.peers.open3d import run_peer

            estimate = run_peer(job.method, dataset, frames, progress)
        seconds = time.perf_counter() - begin
    info = {"dataset": {"name": dataset.name, "frames": [job.first, job.last]}} | estimate.info | {"method": job.method}
    write_estimate(job.out, estimate.stamps, estimate.T_world_depth, estimate.spline, info)
    return estimate, seconds


def _cut(estimate: Estimate, stamps: np.ndarray) -> Estimate:
    """The poses at the frames' times."""
    kept = (estimate.stamps >= stamps[0] - ASSOCIATE_WITHIN_S) & (estimate.stamps <= stamps[-1] + ASSOCIATE_WITHIN_S)
    return Estimate(estimate.stamps[kept], estimate.T_world_depth[kept], estimate.spline, estimate.info)


def _metrics(job: Job, dataset: Dataset, estimate: Estimate) -> tuple[Metrics | None, float | None]:
    """Errors over the job's frames, and the offset of the truth's clock that they are for, s.

    Errors are None if fewer than three of the frames have a pose. Where an offset is asked for and not found, clocks
    are as they are, and the offset is None: one track too short or too bad for it must not spoil the others' tables.
    """
    truth = truth_of(dataset)
    if truth is None:
        return None, None
    truth = dataclasses.replace(truth, frame_stamps=dataset.stamps[job.first : job.last])
    try:
        metrics = evaluate(truth, estimate)
    except UserError:
        return None, None
    if job.truth_offset is None:
        return metrics, None
    try:
        evaluation = evaluate_clocks(truth, estimate, job.truth_offset)
    except UserError:
        return metrics, None
    return evaluation.chosen, evaluation.offset_s
