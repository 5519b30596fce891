"""The commands that map: keyframes, map, map-eval, stress."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import get_args

from rsgen.console.command_line import Commands, count
from rsgen.device.backend import Backend
from rstrack.cli.options import add_options, add_run, add_sequence, number, options_of


def add_mapping(commands: Commands) -> None:
    """Add them to the parser."""
    mapping = commands.add(
        "map", _map, "fuse a sequence's frames along an estimate: writes a coloured mesh (PLY)",
        "out/lr_kt2 runs/lr_kt2 --out lr_kt2.ply --every 5",
    )  # fmt: skip
    add_sequence(mapping)
    add_run(mapping)
    mapping.add_argument("--out", type=Path, required=True, metavar="FILE", help="PLY file to write")
    mapping.add_argument("--cloud", type=Path, metavar="FILE", help="PLY file for a point cloud with normals")
    mapping.add_argument(
        "--shutter", choices=("rs", "gs"),
        help="rs: every line from its own pose; gs: all from the middle line's (default: rs if the run has a spline)",
    )  # fmt: skip
    mapping.add_argument(
        "--world", choices=("truth", "estimate"),
        help="frame of the mesh; truth: trajectories are aligned first (default: truth if the sequence has one)",
    )  # fmt: skip
    mapping.add_argument(
        "--voxel",
        type=number,
        default=0.01,
        metavar="M",
        help="voxels of the distance volume, m (default: 0.01)",
    )
    mapping.add_argument("--every", type=count, default=1, metavar="N", help="use every N-th frame (default: 1)")
    mapping.add_argument(
        "--max-depth", type=number, default=6.0, metavar="M", help="depth beyond this is left out, m (default: 6)"
    )
    mapping.add_argument(
        "--color", action=argparse.BooleanOptionalAction, default=True, help="colour the mesh (default: yes)"
    )
    mapping.add_argument(
        "--backend", choices=get_args(Backend), default="auto", help="where kernels run (default: auto)"
    )
    mapping.add_argument("--quiet", action="store_true", help="no progress")

    evaluate = commands.add(
        "map-eval", _map_eval, "how far a mesh is from the scene, and how much of what was seen it has",
        "lr_kt2.ply out/lr_kt2/scene.ply",
    )  # fmt: skip
    evaluate.add_argument("mesh", type=Path, help="PLY file that 'rstrack map' wrote, in the truth's world")
    evaluate.add_argument("scene", type=Path, help="the sequence's scene.ply")
    evaluate.add_argument("--json", action="store_true", help="print machine-readable figures")

    keyframes = commands.add(
        "keyframes", _keyframes, "fuse every frame into rectified keyframes: writes a TUM RGB-D folder of them",
        "out/table1 runs/table1 --out keyframes",
    )  # fmt: skip
    add_sequence(keyframes)
    add_run(keyframes)
    keyframes.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    keyframes.add_argument(
        "--sigma-px", type=number, default=1.0, metavar="S",
        help="colours count exp(-length of their blur in px / S^2), equation (13); 0: all alike (default: 1)",
    )  # fmt: skip
    keyframes.add_argument("--quiet", action="store_true", help="no progress")

    stress = commands.add(
        "stress", _stress, "blur stress test: one motion at several exposures and speeds, constant against blur-aware "
        "weights", "configs/stress.yaml --out runs/stress --frames 60",
    )  # fmt: skip
    stress.add_argument("config", type=Path, help="rsgen configuration of the motion, for example configs/stress.yaml")
    stress.add_argument("--out", type=Path, required=True, metavar="DIR", help="sequences, runs and tables go here")
    stress.add_argument("--frames", type=count, metavar="N", help="only the first N frames (default: all)")
    stress.add_argument("--quiet", action="store_true", help="no progress")
    add_options(stress)


def _map(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rstrack.mapping.reconstruct import MapOptions, run_map

    chosen = MapOptions(
        options.shutter, options.world, options.voxel, options.every, options.color, options.max_depth, options.backend
    )
    with ProgressDisplay(options.quiet) as progress:
        result = run_map(
            options.sequence, options.run_path, options.out, chosen, options.cloud, options.camera, progress
        )
    print(result.text())
    evaluate = f" (rstrack map-eval {options.out} {options.sequence / 'scene.ply'})" if result.world == "truth" else ""
    print(f"{options.out}: written{evaluate}")
    return 0


def _map_eval(options: argparse.Namespace) -> int:
    from rstrack.metrics.map_eval import run_map_evaluate

    report = run_map_evaluate(options.mesh, options.scene)
    print(json.dumps(report.as_dict(), indent=2) if options.json else report.text())
    return 0


def _keyframes(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rstrack.data.dataset import open_dataset
    from rstrack.data.estimate import read_estimate
    from rstrack.mapping.keyframe_images import write_keyframes

    dataset, estimate = open_dataset(options.sequence, options.camera), read_estimate(options.run_path)
    with ProgressDisplay(options.quiet) as progress:
        count = write_keyframes(dataset, estimate, options.out, options.sigma_px or None, progress=progress)
    print(f"{options.out}: {count} keyframes written")
    return 0


def _stress(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.stress.cases import StressOptions
    from rstrack.bench.stress.run import run_stress
    from rstrack.bench.stress.tables import stress_text, write_stress

    chosen = StressOptions(frames=options.frames, tracker=options_of(options))
    with ProgressDisplay(options.quiet) as progress:
        result = run_stress(options.config, options.out, chosen, progress)
    written = write_stress(result, options.out)
    print(stress_text(result))
    print(f"{options.out}: {len(written)} tables and pictures written")
    return 0
