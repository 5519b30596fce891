"""The commands that map: keyframes, map, map-eval."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Json, Quiet, print_figures
from rstrack.cli.options import CameraFile, Run, SequenceFolder
from rstrack.options import MapOptions


def map_(
    sequence: SequenceFolder,
    run: Run,
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
    """How far a mesh is from the scene, and how much of what was seen it has."""
    from rstrack.metrics.map_eval import run_map_eval

    print_figures(run_map_eval(mesh, scene), json)
    return 0


def keyframes(
    sequence: SequenceFolder,
    run: Run,
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
