"""The commands that work on a finished run: `evaluate`, `plot`, `export`, `report`, `map`, `map-eval`, `keyframes`."""

from __future__ import annotations

from json import dumps
from pathlib import Path
from typing import Annotated, Literal

from rsgen.console.command_line import Json, Quiet, print_figures
from rstrack.cli.options import CameraFile, RunFolder, SequenceFolder, TruthExtrinsics, TruthNoise, TruthOffset
from rstrack.options import MapOptions


def evaluate(
    sequence: Annotated[Path, "rsgen sequence, TUM RGB-D, ICL-NUIM or 7-Scenes folder; or a TUM file of true poses"],
    run: RunFolder,
    *,
    camera: CameraFile = None,
    truth_offset: TruthOffset = None,
    truth_extrinsics: TruthExtrinsics = None,
    truth_noise: TruthNoise = None,
    against: Annotated[
        Path | None,
        "another run of the sequence: ends with one line that compares the two, for example of gs-pg",
        "RUN",
    ] = None,
    json: Json = False,
) -> int:
    """Compare a run with the ground truth: ATE, drift per second, poses of rows, and whether its covariances fit the
    errors."""
    from rstrack.metrics.evaluate import compared
    from rstrack.metrics.run_evaluate import run_evaluate

    how = camera, truth_offset, truth_extrinsics, truth_noise
    ours = run_evaluate(sequence, run, *how)
    theirs = None if against is None else run_evaluate(sequence, against, *how)
    if json:
        print(dumps(ours.as_dict() | ({"against": theirs.as_dict()} if theirs else {}), indent=2))
    else:
        print(ours.text())
        if against is not None and theirs is not None:
            print(f"\n{compared(run, ours.chosen, against, theirs.chosen)}")
    return 0


def plot(
    sequence: SequenceFolder,
    run: RunFolder,
    *,
    camera: CameraFile = None,
    truth_offset: TruthOffset = None,
    out: Annotated[Path, "png, pdf or svg file to write", "FILE"],
) -> int:
    """Draw a run: path, errors over time, inliers."""
    from rstrack.charts.runs import run_plot

    run_plot(sequence, run, out, camera, truth_offset)
    print(f"{out}: written")
    return 0


def export(
    run: Annotated[Path, "folder that 'rstrack track' wrote"],
    what: Annotated[
        Literal["covariance"],
        "covariance: TUM lines with the pose's covariance against the first frame, in the depth camera's frame, as "
        "smfeval reads them",
        "covariance",
    ],
    *,
    out: Annotated[Path, "file to write", "FILE"],
) -> int:
    """Write a run's poses with their covariances for other tools."""
    from rstrack.metrics.consistency import write_covariances

    print(f"{out}: {write_covariances(run, out)} poses written")
    return 0


def report(
    run: Annotated[
        Path,
        "folder that 'rstrack track' or 'rstrack bench' wrote, a calibration.json, or a TUM file with --sequence",
    ],
    *,
    sequence: Annotated[Path | None, "the run's sequence (default: where it was)", "DIR"] = None,
    camera: CameraFile = None,
    truth_offset: TruthOffset = None,
    out: Annotated[Path | None, "page to write (default: report.html in the folder)", "FILE"] = None,
    quiet: Quiet = False,
) -> int:
    """Write one HTML page of a run, a calibration, a benchmark or a stress test: tables, plots, the path in 3D,
    rolling against global shutter.
    """
    from rsgen.console.progress import ProgressDisplay
    from rstrack.report.build import write_report

    with ProgressDisplay(quiet) as progress:
        page = write_report(run, sequence, out, camera, progress, truth_offset)
    print(f"{page}: written, open it in a browser")
    return 0


def map_(
    sequence: SequenceFolder,
    run: RunFolder,
    map: MapOptions,
    *,
    camera: CameraFile = None,
    out: Annotated[Path, "PLY file to write", "FILE"],
    cloud: Annotated[Path | None, "PLY file for a point cloud with normals", "FILE"] = None,
    quiet: Quiet = False,
) -> int:
    """Fuse a sequence's frames along an estimate: writes a coloured mesh (PLY)."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.mapping.map import run_map

    with ProgressDisplay(quiet) as progress:
        result = run_map(sequence, run, out, map, cloud, camera, progress)
    print(result.text())
    evaluate = f" (rstrack map-eval {out} {sequence / 'scene.ply'})" if result.world == "truth" else ""
    print(f"{out}: written{evaluate}")
    return 0


def map_eval(
    mesh: Annotated[Path, "PLY file that 'rstrack map' wrote, in the truth's world"],
    scene: Annotated[Path, "the sequence's scene.ply"],
    *,
    json: Json = False,
) -> int:
    """Compare a mesh with the scene: its distance, and how much of the observed surface it has."""
    from rstrack.metrics.map_eval import run_map_eval

    print_figures(run_map_eval(mesh, scene), json)
    return 0


def keyframes(
    sequence: SequenceFolder,
    run: RunFolder,
    *,
    camera: CameraFile = None,
    out: Annotated[Path, "folder to write", "DIR"],
    sigma_px: Annotated[
        float, "colours count exp(-length of their blur in px / S^2), equation (13); 0: all alike", "S"
    ] = 1.0,
    quiet: Quiet = False,
) -> int:
    """Fuse every frame into rectified keyframes: writes a TUM RGB-D folder of them."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.data.dataset import open_tracked
    from rstrack.data.estimate import read_estimate
    from rstrack.mapping.keyframes import write_keyframes

    estimate = read_estimate(run)
    dataset = open_tracked(sequence, run, estimate.info, camera)
    with ProgressDisplay(quiet) as progress:
        count = write_keyframes(dataset, estimate, out, sigma_px or None, progress=progress)
    print(f"{out}: {count} keyframes written")
    return 0
