"""The commands that measure the tracker: bench-speed, -convergence, -bootstrap, -calibration, -long and -loops."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Frames, Json, print_figures
from rsgen.device.backend import Backend
from rstrack.cli.options import CameraFile, NoiseDepth, NoiseIntensity, SequenceFolder
from rstrack.options import Method, Options, Peer

Seed = Annotated[int, "of the random choices", int]


def bench_speed(
    sequence: SequenceFolder,
    tracker: Options,
    *,
    camera: CameraFile = None,
    frames: Annotated[
        int, "track the first N frames; the first 20 (at most half) warm up and are not counted", "N"
    ] = 150,
    json: Json = False,
    method: Annotated[
        list[Method] | None, "method to time; may be given several times (default: rs-g and rs-pg)"
    ] = None,
    peer: Annotated[list[Peer] | None, "time Open3D's odometry on the same frames; may be given several times"] = None,
) -> int:
    """Time the tracker: milliseconds a frame, and where they go."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.speed import time_methods
    from rstrack.data.dataset import open_dataset

    methods: list[Method] = method or ["rs-g", "rs-pg"]
    dataset = open_dataset(sequence, camera)
    with ProgressDisplay(quiet=json) as progress:
        found = time_methods(dataset, [replace(tracker, method=m) for m in methods], frames, progress, peer or ())
    print_figures(found, json)
    return 0


def bench_convergence(
    sequence: SequenceFolder,
    tracker: Options,
    *,
    camera: CameraFile = None,
    pairs: Annotated[int, "keyframes with a frame", "N"] = 50,
    seed: Seed = 0,
    json: Json = False,
) -> int:
    """Align single frames to a keyframe from poses ever farther off."""
    from rsgen.console.progress import ProgressDisplay
    from rsgen.device.arrays import engine
    from rstrack.data.dataset import open_dataset

    dataset = open_dataset(sequence, camera)
    # Before the tracker imports Dr.Jit, which then would choose a libLLVM itself.
    engine(tracker.backend)
    from rstrack.bench.convergence import convergence

    with ProgressDisplay(quiet=json) as progress:
        found = convergence(dataset, tracker, pairs, seed, progress)
    print_figures(found, json)
    return 0


def bench_bootstrap(
    sequence: SequenceFolder,
    tracker: Options,
    *,
    camera: CameraFile = None,
    starts: Annotated[int, "how many", "N"] = 50,
    frames: Annotated[int, "frames of each", "N"] = 20,
    seed: Seed = 0,
    json: Json = False,
) -> int:
    """Start the tracker at random frames: how many starts fail, and how good the others are."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.bootstrap import bootstraps
    from rstrack.data.dataset import open_dataset

    dataset = open_dataset(sequence, camera)
    with ProgressDisplay(quiet=json) as progress:
        found = bootstraps(dataset, tracker, starts, frames, seed, progress)
    print_figures(found, json)
    return 0


def bench_calibration(
    sequence: SequenceFolder,
    *,
    camera: CameraFile = None,
    frames: Frames = None,
    starts: Annotated[int, "wrong cameras at each distance", "N"] = 5,
    factors: Annotated[
        list[float] | None, "distances, in units of 50 % of readouts, 15 ms, 5 mm and 0.5 deg (default: 0 1 2 4)"
    ] = None,
    noise_depth: NoiseDepth = 0.0,
    noise_intensity: NoiseIntensity = 0.0,
    seed: Seed = 0,
    backend: Annotated[Backend, "where kernels run"] = "auto",
    json: Json = False,
) -> int:
    """Calibrate from cameras that are told ever more wrongly: which are found, and whether the errors' sizes are true.

    The cameras of the sequence are taken for the truth; of one that declares others, those in truth/cameras.yaml.
    """
    from rsgen.console.progress import ProgressDisplay
    from rsgen.sequence.camera_yaml import TRUE_CAMERAS
    from rstrack.bench.calibration import FACTORS, calibrations
    from rstrack.data.dataset import open_dataset

    declared = sequence / TRUE_CAMERAS
    dataset = open_dataset(sequence, declared if camera is None and declared.exists() else camera)
    noise = noise_depth, noise_intensity
    options = Options(backend=backend)
    with ProgressDisplay(quiet=json) as progress:
        found = calibrations(dataset, frames or slice(None), starts, factors or FACTORS, noise, seed, options, progress)
    print_figures(found, json)
    return 0


def bench_long(
    sequence: SequenceFolder,
    tracker: Options,
    *,
    camera: CameraFile = None,
    frames: Annotated[int, "how many", "N"] = 10_000,
    loop: Annotated[int, "the sequence's first N, over and over", "N"] = 90,
    json: Json = False,
) -> int:
    """Feed a sequence over and over: whether a frame costs as much after N frames as at the start, and memory."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.long import long_run
    from rstrack.data.dataset import open_dataset

    dataset = open_dataset(sequence, camera)
    with ProgressDisplay(quiet=json) as progress:
        found = long_run(dataset, tracker, frames, loop, progress)
    print_figures(found, json)
    return 0


def bench_loops(
    sequence: SequenceFolder,
    tracker: Options,
    *,
    camera: CameraFile = None,
    frames: Frames = None,
    alike: Annotated[int, "pairs of different places that look alike to try", "N"] = 200,
    other: Annotated[Path | None, "try those with this recording of another room by the same cameras", "SEQ"] = None,
    json: Json = False,
) -> int:
    """Find the loops of a track: how true they are, and whether places that look alike are taken for one."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.loops import loop_quality
    from rstrack.data.dataset import open_dataset

    dataset = open_dataset(sequence, camera)
    with ProgressDisplay(quiet=json) as progress:
        elsewhere = None if other is None else open_dataset(other, camera)
        found = loop_quality(dataset, tracker, frames or slice(None), alike, progress, elsewhere)
    print_figures(found, json)
    return 0
