"""The commands that work on a finished run: `evaluate`, `export`, `report`, `map`."""

from __future__ import annotations

from json import dumps
from pathlib import Path
from typing import Annotated, Literal

from rsgen.console.command_line import Json, Quiet, print_figures, refuse_options
from rsgen.errors import UserError
from rstrack.cli.options import CameraFile, RunFolder, SequenceFolder, TruthExtrinsics, TruthNoise, TruthOffset
from rstrack.options import MapOptions

RunSequence = Annotated[Path | None, "the run's sequence (default: where it was)", "DIR"]


def evaluate(
    sequence: Annotated[
        Path,
        "rsgen sequence, TUM RGB-D, ICL-NUIM or 7-Scenes folder; or a TUM file of true poses; or a PLY file of the "
        "true surface",
    ],
    run: Annotated[Path, "folder that 'rstrack track' wrote, or a TUM file; or a PLY file that 'rstrack map' wrote"],
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
    """Compare a run, or a mesh, with the ground truth. Of a run: ATE, drift per second, poses of rows, and whether its
    covariances fit the errors. Of a mesh: its distance from the scene, and how much of the observed surface it has.
    """
    if run.suffix.lower() == ".ply":
        from rstrack.metrics.map_eval import run_map_eval

        refuse_options("a mesh", {
            "--camera": camera, "--truth-offset": truth_offset is not None, "--truth-extrinsics": truth_extrinsics,
            "--truth-noise": truth_noise is not None, "--against": against,
        })  # fmt: skip
        scene = sequence if sequence.suffix.lower() == ".ply" else sequence / "scene.ply"
        print_figures(run_map_eval(run, scene), json)
        return 0
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


def export(
    run: Annotated[Path, "folder that 'rstrack track' wrote"],
    what: Annotated[
        Literal["covariance", "keyframes"],
        "covariance: TUM lines with the pose's covariance against the first frame, in the depth camera's frame, as "
        "smfeval reads them; keyframes: a TUM RGB-D folder of rectified keyframes, every frame fused into them, with "
        "one pose each",
        "covariance|keyframes",
    ],
    *,
    out: Annotated[Path, "file, or folder of the keyframes, to write", "PATH"],
    sequence: RunSequence = None,
    camera: CameraFile = None,
    sigma_px: Annotated[
        float | None,
        "of keyframes, colours count exp(-length of their blur in px / S^2), equation (13); 0: all alike (default: 1)",
        "S",
    ] = None,
    quiet: Quiet = False,
) -> int:
    """Write what a run found for other tools: poses with their covariances, or keyframes."""
    if what == "covariance":
        from rstrack.metrics.consistency import write_covariances

        refuse_options(what, {"--sequence": sequence, "--camera": camera, "--sigma-px": sigma_px is not None})
        print(f"{out}: {write_covariances(run, out)} poses written")
        return 0
    from rsgen.console.progress import ProgressDisplay
    from rstrack.mapping.keyframes import write_keyframes
    from rstrack.metrics.run_evaluate import load_run

    tracked = load_run(run, sequence, camera)
    if tracked.dataset is None:
        raise UserError(f"{run}: {tracked.notes[0][0].lower()}{tracked.notes[0][1:]}")
    blur_px = 1.0 if sigma_px is None else sigma_px or None
    with ProgressDisplay(quiet) as progress:
        count = write_keyframes(tracked.dataset, tracked.estimate, out, blur_px, progress=progress)
    print(f"{out}: {count} keyframes written")
    return 0


def report(
    run: Annotated[
        Path,
        "folder that 'rstrack track' or 'rstrack bench' wrote, a calibration.json, or a TUM file with --sequence",
    ],
    *,
    sequence: RunSequence = None,
    camera: CameraFile = None,
    truth_offset: TruthOffset = None,
    out: Annotated[
        Path | None,
        "page to write (default: report.html in the folder); or a .png, .pdf or .svg: a run's path and errors as a "
        "picture",
        "FILE",
    ] = None,
    quiet: Quiet = False,
) -> int:
    """Write one HTML page of a run, a calibration, a benchmark or a stress test, or a picture of a run. The page has
    tables, plots, the path in 3D, rolling against global shutter.
    """
    if out is not None and out.suffix.lower() not in ("", ".html", ".htm"):
        from rstrack.charts.runs import run_plot

        run_plot(sequence, run, out, camera, truth_offset)
        print(f"{out}: written")
        return 0
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
    evaluate = f" (rstrack evaluate {sequence} {out})" if result.world == "truth" else ""
    print(f"{out}: written{evaluate}")
    return 0
