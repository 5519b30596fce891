"""What the tests of `rstrack report` share: folders to report on, and a parser that takes pages apart."""

from __future__ import annotations

import base64
import dataclasses
import json
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import synthetic
import tum_recording as tum
import yaml
from bench_evaluation import made_up_record

from rsgen.config.sections import TruthConfig
from rsgen.geometry import se3
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_png
from rsgen.sequence.format import pose_rows
from rstrack.bench.experiments.method_tables import write_results
from rstrack.bench.experiments.methods import Results, SequenceInfo
from rstrack.bench.experiments.stress import StressResult
from rstrack.bench.experiments.stress_results import write_stress
from rstrack.bench.measures.blur import PANELS, Panels
from rstrack.bench.record import CellRecord
from rstrack.calibration.record import CALIBRATION
from rstrack.data.dataset import open_dataset
from rstrack.data.estimate import write_estimate
from rstrack.metrics.run_evaluate import run_evaluate

SPLINE = synthetic.make_spline()
WORLD = se3.exp(np.array([3.0, -1.0, 2.0, 0.4, -0.3, 0.4]))
FRAMES = 31
NASTY = "</script><b>&"


@dataclass
class Parsed(HTMLParser):
    """What a test wants to know of a page: attributes, tables as lists of rows, scripts, and the text of the rest."""

    attributes: list[tuple[str, str, str]] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)
    scripts: list[str] = field(default_factory=list)
    styles: list[str] = field(default_factory=list)
    text: str = ""
    figures: Any = None

    def __post_init__(self) -> None:
        super().__init__()
        self._in: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in ("meta", "link", "img", "input", "br"):
            self._in.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self._in.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._in and self._in[-1] in ("script", "style"):
            (self.scripts if self._in[-1] == "script" else self.styles).append(data)
            return
        self.text += data
        if {"td", "th"} & set(self._in):
            self.rows[-1][-1] = " ".join((self.rows[-1][-1] + " " + data).split())

    def row(self, name: str) -> list[str]:
        """The first row of a table with this heading."""
        return next(row for row in self.rows if row[0] == name)

    def uris(self) -> list[str]:
        return [value for tag, name, value in self.attributes if (tag, name) == ("img", "src")]


def parse(path: Path) -> Parsed:
    parsed = Parsed()
    parsed.feed(path.read_text("utf-8"))
    parsed.close()
    parsed.figures = json.loads(parsed.scripts[0])
    return parsed


def picture(uri: str) -> np.ndarray:
    kind, _, data = uri.partition(",")
    assert kind == "data:image/jpeg;base64"
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data, validate=True), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image)


def global_image(config: Any, stamp: float) -> np.ndarray:
    """The colour image that all lines would show at the middle one's time."""
    camera, shutter = config.color.camera, config.color.shutter
    middle = float(shutter.line_mid_time(stamp, (shutter.line_count(camera) - 1) / 2, camera))
    return synthetic.render_color(SPLINE, camera, Shutter(), middle, np.array(config.T_color_depth))


def make_sequence(root: Path, *, twin: bool = False) -> Path:
    config = synthetic.make_config()
    if not twin:
        return synthetic.make_sequence(root, config, FRAMES)
    config = config.model_copy(update={"truth": TruthConfig(global_shutter=("middle",))})
    writer = synthetic.open_writer(root, config, FRAMES)
    for k in range(FRAMES):
        stamp, T = float(writer.stamps("color")[k]), np.array(config.T_color_depth)
        image = synthetic.render_color(SPLINE, config.color.camera, config.color.shutter, stamp, T)
        writer.write_color(k, image, {"global_middle": global_image(config, stamp)})
        writer.write_depth(k, synthetic.render_depth(SPLINE, config.depth.camera, config.depth.shutter, stamp))
    writer.finish()
    return root


def make_run(run: Path, sequence: Path, seed: int = 1, error_m: float = 0.004, **info: Any) -> Path:
    """A run folder with errors of known size; two frames are lost."""
    stamps = open_dataset(sequence).stamps
    rng = np.random.default_rng(seed)
    xi = error_m * rng.normal(size=(len(SPLINE.control_points), 6))
    spline = Spline(se3.orthonormalise(WORLD @ SPLINE.control_points @ se3.exp(xi)), SPLINE.t0, SPLINE.dt)
    kept = np.delete(np.arange(len(stamps)), [10, 11, 12, 13])
    frames = [
        {"stamp": float(t), "inliers_depth": 0.8, "inliers_color": None, "keyframe": k % 8 == 0, "lost": 10 <= k < 14}
        for k, t in enumerate(stamps)
    ]
    info = {
        "method": "rs-pg", "lost": 4, "frames": frames, "options": {"method": "rs-pg", "knot_spacing_s": 0.025},
        "timings": {"median_ms": 12.5, "frame_ms": [12.5] * len(stamps)}, "end": "done",
        "dataset": {"name": NASTY, "frames": [0, FRAMES], "path": str(sequence)},
    } | info  # fmt: skip
    write_estimate(run, stamps[kept], spline.pose(stamps[kept]), spline, info)
    return run


EPOCH, EPOCH_FRAMES, TRUTH_OFFSET_S = 1305031453.371, 96, -0.03


def make_epoch_run(folder: Path) -> tuple[Path, Path]:
    """A TUM recording with stamps of 2011, whose truth is stamped 30 ms early, and a run of it: both folders.

    The recording's camera file says 30 ms for both readouts; the run was told 26 (colour) and 34 (depth).
    """
    root, run = folder / "recording", folder / "run"
    lens = {"width": tum.WIDTH, "height": tum.HEIGHT, "intrinsics": tum.INTRINSICS}
    both = {name: lens | {"readout_s": 0.03} for name in ("color", "depth")}
    tum.make_tum(root, both | {"stamps": "raw"})
    t = np.arange(EPOCH_FRAMES) / 30.0
    for name in ("depth", "rgb"):
        tum.write_listing(root / f"{name}.txt", [f"{EPOCH + s:.6f} {name}/{tum.STAMPS[0]:.4f}.png" for s in t])
    wiggle = np.random.default_rng(1).normal(size=(50, 6)) * [0.05, 0.05, 0.05, 0.06, 0.06, 0.06]
    motion = Spline(se3.exp(wiggle), -0.5, 0.1)
    mocap = np.arange(-0.4, 3.9, 0.01)
    rows = np.column_stack([EPOCH + mocap + TRUTH_OFFSET_S, pose_rows(se3.orthonormalise(motion.pose(mocap)))])
    np.savetxt(root / "groundtruth.txt", rows, fmt="%.9f")
    other = {"color": lens | {"readout_s": 0.026}, "depth": lens | {"readout_s": 0.034}, "stamps": "raw"}
    (folder / "other.yaml").write_text(yaml.safe_dump(other))
    dataset = open_dataset(root, folder / "other.yaml")
    frames = [
        {"stamp": float(s), "inliers_depth": 0.8, "inliers_color": 0.7, "keyframe": k % 8 == 0, "lost": False}
        for k, s in enumerate(dataset.stamps)
    ]
    info = {
        "method": "rs-pg", "frames": frames, "timings": {"median_ms": 12.5, "frame_ms": [12.5] * len(frames)},
        "dataset": {"name": dataset.name, "path": str(root), "camera": dataset.cameras},
    }  # fmt: skip
    write_estimate(run, dataset.stamps, se3.orthonormalise(motion.pose(t)), None, info)
    return root, run


def shown(value: float | None, scale: float = 1.0) -> str:
    assert value is not None
    return f"{value * scale:.4g}"


def make_bench(root: Path, sequence: Path, twin: Path) -> Results:
    """A benchmark of two sequences and three methods, one of which has failed on one of them."""
    methods, errors, records = ("baseline", "rs-pg", "open3d-icp"), (0.05, 0.001, 0.01), []
    infos = SequenceInfo("robot_t1", "hand-held", sequence, FRAMES), SequenceInfo("lr_kt2", "living room", twin, FRAMES)
    for info in infos:
        for k, method in enumerate(methods):
            if (info.name, method) == ("lr_kt2", "open3d-icp"):
                records.append(made_up_record(info.name, method, "is not here"))
                continue
            run = make_run(root / "cells/track" / info.name / method, info.path, seed=k, error_m=errors[k])
            found = run_evaluate(info.path, run).metrics
            assert found.rpe_trans_rmse_m_per_s is not None
            figures = {"ate_mm": 1e3 * found.ate_rmse_m, "drift_mm_s": 1e3 * found.rpe_trans_rmse_m_per_s}
            figures |= {"drift_deg_s": found.rpe_rot_rmse_deg_per_s, "frames": FRAMES, "lost": 4, "total_s": 3.1}
            records.append(made_up_record(info.name, method, **figures))
    results = Results(sequences=infos, methods=methods, records=tuple(records))
    write_results(results, root)
    return results


def stress_record(
    case: str, speed: float, exposure_s: float, variant: str, figures: dict[str, Any], measure: str = "track"
) -> CellRecord:
    """One of a stress test."""
    record = made_up_record(case, f"rs-pg-{variant.replace(' ', '_').replace(',', '')}", measure=measure, **figures)
    about = {"sequence": case, "motion": NASTY, "speed": speed, "exposure_s": exposure_s, "variant": variant}
    return dataclasses.replace(record, settings={"settings": about | {"sigmas_px": [0.5, 1.0]}})


def make_stress(root: Path, seed: int = 5) -> StressResult:
    """The folder of a stress test of four sequences; the estimated path has a score that cannot be had."""
    rng = np.random.default_rng(seed)
    cases = [("exposure_0ms", 1.0, 0.0), ("exposure_20ms", 1.0, 0.02), ("exposure_30ms", 1.0, 0.03)]
    cases.append(("exposure_20ms_speed_2x", 2.0, 0.02))
    records = []
    for case, speed, exposure in cases:
        figures: dict[str, Any] = {}
        for poses in ("true", "estimated"):
            for weights in ("constant", "sigma0.5", "sigma1"):
                key = f"{poses}_{weights}"
                figures |= {f"psnr_db_{key}": rng.uniform(30, 35), f"psnr_db_least_{key}": rng.uniform(25, 30)}
                figures |= {f"ssim_{key}": rng.uniform(0.5, 1), f"gradient_{key}": rng.uniform(0.1, 0.9)}
                if (case, poses) == ("exposure_0ms", "estimated"):
                    figures[f"ssim_{key}"] = None
            figures |= {f"keyframes_{poses}": 4, f"pixels_{poses}": 1000}
            figures |= {f"single_mm_{poses}": rng.uniform(2, 3), f"fused_mm_{poses}": rng.uniform(1, 2)}
        for variant, measure in (("mid-exposure", "blur"), ("end of exposure", "track")):
            drift = None if speed > 1.0 else rng.uniform(1, 2)
            tracked = {"ate_mm": rng.uniform(0.1, 4), "drift_mm_s": drift, "lost": int(speed) - 1, "frames": 31}
            of_measure = tracked | (figures if measure == "blur" else {})
            records.append(stress_record(case, speed, exposure, variant, of_measure, measure))
    records.append(stress_record("exposure_30ms", 1.0, 0.03, "blur weight", {"lost": 31, "frames": 31}))
    folder = root / "cells/blur/exposure_20ms/rs-pg-mid-exposure/panels"
    folder.mkdir(parents=True)
    for name in PANELS:
        image = cv2.blur(rng.integers(0, 256, (48, 64, 3)).astype(np.uint8), (5, 5))
        (folder / f"{name}.png").write_bytes(encode_png(image))
    about = Panels(keyframe=12, width=64, height=48, white=0.25)
    (folder / "panels.json").write_text(about.model_dump_json())
    return write_stress(records, root)[0]


def calibration() -> dict[str, Any]:
    """What `rstrack calibrate --json` says: two values found in ms and one in degrees, one undetermined."""

    def value(label: str, unit: str, factor: float, found: float, sigma: float | None, told: list[float]) -> Any:
        return {
            "value": found / factor, "start": 0.0, "sigma": None if sigma is None else sigma / factor,
            "state": "undetermined" if sigma is None else "found", "told_by_stretch": told,
            "shown": {"label": label, "unit": unit, "factor": factor}, "useful_sigma": 2.0 / factor,
            "needs": "motion that changes",
        }  # fmt: skip

    t = np.linspace(0.0, 6.0, 61)
    return {
        "dataset": NASTY,
        "parameters": {
            "depth.readout_s": value("depth readout", "ms", 1e3, 27.957, 0.022, [0.25, 0.75]),
            "color.offset_s": value("colour offset", "ms", 1e3, -0.5, 0.3, [0.5, 0.5]),
            "color.drift": value("colour drift", "ms", 1e3, 0.0, None, [0.0, 0.0]),
            "T_color_depth.rz": value(
                "colour from depth, about z", "deg", float(np.degrees(1.0)), -0.14, 0.06, [0.9, 0.1]
            ),
        },
        "stretches": [[10, 20], [30, 50]], "stretch_times_s": [[1.0, 2.0], [3.0, 5.0]],
        "residuals": {"depth_m": {"before": 8e-3, "after": 2e-3}, "intensity": {"before": 0.04, "after": 0.01}},
        "pace": {"time_s": t.tolist(), "m_s": np.abs(np.sin(t)).tolist(), "rad_s": (0.5 * np.abs(np.cos(t))).tolist()},
        "finished": True, "converged": True, "notes": ["offsets are against depth's stamps"], "seconds": 31.2,
        "camera_file": "color:\n  width: 640\n",
    }  # fmt: skip


def write_calibration(folder: Path, data: dict[str, Any]) -> Path:
    path = folder / CALIBRATION
    path.write_text(json.dumps(data))
    return path
