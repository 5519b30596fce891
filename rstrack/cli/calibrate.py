"""The command `rstrack calibrate`."""

from __future__ import annotations

import sys
from dataclasses import replace
from json import dumps
from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Frames, Json, Quiet
from rsgen.device.backend import Backend
from rstrack.cli.options import CameraFile, DeviceName, NoiseDepth, NoiseIntensity, Seed, SequenceFolder

STATUS = (
    "exit status: 0 done, 1 some values are not told by the recording, or not converged, 2 wrong input, 130 interrupted"
)


def calibrate(
    sequence: SequenceFolder,
    *,
    camera: CameraFile = None,
    free: Annotated[
        str | None,
        "what to estimate, of readout, offset, extrinsics, depth, intrinsics (default: the first three; depth that is "
        "registered to colour has no extrinsics)",
        "NAMES",
    ] = None,
    device: DeviceName = None,
    frames: Frames = None,
    backend: Annotated[Backend, "where kernels run"] = "auto",
    noise_depth: NoiseDepth = 0.0,
    noise_intensity: NoiseIntensity = 0.0,
    seed: Seed = 0,
    out: Annotated[Path | None, "camera file to write, for rstrack track --camera", "FILE"] = None,
    report: Annotated[Path | None, "HTML page of the calibration to write", "FILE"] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Readouts, clocks and extrinsics of a recording's cameras, from the recording alone, with their errors."""
    from rsgen.console.progress import ProgressDisplay
    from rsgen.files import atomic_write
    from rstrack.calibration.findings.record import record_of
    from rstrack.calibration.run import calibrate as run
    from rstrack.calibration.unknowns.devices import device_named
    from rstrack.data.dataset import open_dataset
    from rstrack.data.noise import NoisyImages
    from rstrack.options import Options
    from rstrack.report.build import write_page
    from rstrack.report.calibration import calibration_page

    known = None if device is None else device_named(device)
    dataset = open_dataset(sequence, camera)
    if noise_depth or noise_intensity:
        dataset = replace(dataset, images=NoisyImages(dataset.images, noise_depth, noise_intensity, seed))
    with ProgressDisplay(quiet) as progress:
        groups = None if free is None else tuple(name.strip() for name in free.split(",") if name.strip())
        found = run(dataset, groups, frames or slice(None), Options(backend=backend), progress, known)
    if out is not None:
        atomic_write(out, found.camera_file().encode())
    print(dumps(found.as_dict(), indent=2) if json else found.text())
    if out is not None and not json:
        print(f"{out}: written (rstrack track {sequence} --camera {out} --out RUN)")
    if report is not None:
        write_page(calibration_page(record_of(found)), report)
        if not json:
            print(f"{report}: written, open it in a browser")
    sys.stdout.flush()
    if not found.solution.finished:
        print("rstrack: interrupted; this is the best so far", file=sys.stderr)
        return 130
    return 1 if found.undetermined.any() or not found.solution.is_settled else 0
