"""`rstrack report`: which page a folder or file gets, and the page of one tracking run.

out = write_report(Path("runs/lr_kt2"))
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rstrack.bench.experiments.methods import RESULTS
from rstrack.bench.experiments.stress import STRESS
from rstrack.calibration.record import CALIBRATION, read_record
from rstrack.charts.runs import error_charts, inlier_charts, path_chart, time_charts
from rstrack.data.estimate import TRAJECTORY
from rstrack.metrics.evaluate import Metrics
from rstrack.metrics.run_evaluate import RunEvaluation, Tracked, evaluate_clocks, load_run
from rstrack.metrics.truth_fit import TruthOffset
from rstrack.report.bench import bench_page, stress_page
from rstrack.report.calibration import calibration_page, calibration_section, calibration_warnings
from rstrack.report.page import Card, CardRow, Note, Page, PageSection, Plot, number, plots, write_page
from rstrack.report.pictures import frame_panels, shutter_sliders

REPORT = "report.html"
_AS_STORED = "table, path and curves go by the truth's clock as stored; --truth-offset auto: by the fitted one"


def write_report(
    folder: Path, sequence: Path | None = None, out: Path | None = None, camera_file: Path | None = None,
    progress: Progress = no_progress, truth_offset: TruthOffset | None = None,
) -> Path:  # fmt: skip
    """Write the page of a run folder, a TUM file with a sequence, a calibration.json, or the folder of a benchmark or
    of a stress test.

    Returns its path. sequence: where the run's sequence is, by default where run.json says. out: the file, by default
    report.html in the folder. camera_file: as in `open_tracked`. progress: called with a stage, the
    fraction done (0 to 1) and a note. truth_offset: of the truth's clock, as in `evaluate_clocks`; a benchmark has its
    own. Raises UserError: `folder` is none of these, something that was named cannot be read, no such offset is found,
    or the page cannot be written.
    """
    folder = Path(folder)
    page = _page(folder, sequence, camera_file, progress, truth_offset)
    return write_page(page, out or (folder / REPORT if folder.is_dir() else folder.with_suffix(".html")))


def _page(
    folder: Path, sequence: Path | None, camera_file: Path | None, progress: Progress, truth_offset: TruthOffset | None
) -> Page:  # fmt: skip
    is_bench = (folder / RESULTS).is_file()
    if is_bench or (folder / STRESS).is_file():
        if sequence is not None or camera_file is not None:
            kind = "benchmark" if is_bench else "stress test"
            raise UserError(f"{folder}: a {kind} knows its sequences: leave --sequence and --camera out")
        if truth_offset is not None:
            how = "give it to 'rstrack bench'" if is_bench else "its sequences have one clock"
            raise UserError(f"{folder}: the errors are there already: leave --truth-offset out ({how})")
        return bench_page(folder, progress) if is_bench else stress_page(folder)
    if folder.suffix == ".json":
        if sequence is not None or camera_file is not None or truth_offset is not None:
            raise UserError(f"{folder}: a calibration is all there: leave --sequence, --camera and --truth-offset out")
        return calibration_page(read_record(folder))
    if folder.is_dir() and not (folder / TRAJECTORY).is_file():
        raise UserError(
            f"{folder}: holds neither {TRAJECTORY}, {RESULTS} nor {STRESS}: give a folder that 'rstrack track' "
            "or 'rstrack bench' wrote"
        )
    return run_page(folder, sequence, camera_file, truth_offset)


def run_page(
    run: Path, sequence: Path | None = None, camera_file: Path | None = None, truth_offset: TruthOffset | None = None
) -> Page:
    """Gather everything about a run folder, or a TUM file with a sequence; arguments as in `load_run`.

    Raises UserError, for the offset only if it was asked for.
    """
    tracked = load_run(run, sequence, camera_file)
    if truth_offset is not None and tracked.truth is None:
        raise UserError(f"{run}: there is no truth whose clock could be moved: name its --sequence, or leave "
                        "--truth-offset out")  # fmt: skip
    info = tracked.estimate.info
    sections: list[PageSection] = []
    evaluation = None
    if tracked.truth is not None and (tracked.found is not None or truth_offset is not None):
        evaluation = evaluate_clocks(tracked.truth, tracked.estimate, truth_offset)
        metrics = evaluation.chosen
        lines = (*evaluation.clocks, *([_AS_STORED] if evaluation.hint else []), *metrics.notes)
        notes = (Note(f"{line[0].upper()}{line[1:]}.") for line in lines)
        sections.append(PageSection("errors", "Errors", (metrics.table(), *notes)))
        if evaluation.asked:
            tracked = load_run(run, dataset=tracked.dataset, truth_offset=evaluation.offset_s)
    sections.append(PageSection("path", "Path", (Plot(path_chart({"estimated": tracked})),)))
    if evaluation is not None:
        sections.append(PageSection("time", "Errors over time", plots(error_charts(tracked))))
    if charts := (*inlier_charts(tracked), *time_charts(tracked)):
        sections.append(PageSection("tracker", "What the tracker reported", plots(charts)))
    warnings = list(tracked.notes)
    if tracked.dataset is not None:
        try:
            blocks = (*frame_panels(tracked, tracked.dataset), *shutter_sliders(tracked, tracked.dataset))
            sections.append(PageSection("images", "Images", blocks))
        except UserError as error:
            warnings.append(f"Images are left out: {error}.")
    if (run / CALIBRATION).is_file():
        record = read_record(run / CALIBRATION)
        sections.append(calibration_section(record))
        warnings += [f"Calibration: {text[0].lower()}{text[1:]}" for text in calibration_warnings(record)]
    if info.get("end") not in (None, "done"):
        warnings.insert(0, f"The run ended early: {info['end']}. {info.get('error') or ''}".strip())
    name = tracked.dataset.name if tracked.dataset else _of(info, "dataset").get("name")
    return Page(
        title=f"{name or run.resolve().stem}, tracked" + (f" with {info['method']}" if "method" in info else ""),
        subtitle=_subtitle(tracked),
        cards=_cards(tracked, evaluation),
        sections=tuple(sections),
        facts=(("first frame", f"stamped {tracked.begin_s:.3f} s"), *_facts(info)),
        warnings=tuple(warnings),
    )


# ---------------------------------------------------------------------------------------------------------------------


def _cards(tracked: Tracked, evaluation: RunEvaluation | None) -> tuple[CardRow, ...]:
    """A row of errors for each of the truth's clocks where there are two, and what else there is to say."""
    info = tracked.estimate.info
    frames, lost = len(tracked.frames), info.get("lost")
    rows: list[CardRow] = []
    cards: list[Card] = []
    if evaluation is not None:
        m, by_clock = evaluation.metrics, evaluation.by_clock
        if len(by_clock) > 1:
            rows = [CardRow(_errors(each), f"{clock[0].upper()}{clock[1:]}") for clock, each in by_clock]
        else:
            cards += _errors(m)
        notes = [f"{lost} lost"] if lost else []
        notes += [f"the run is of {frames}"] if 0 < frames < m.frames else []
        cards.append(Card(f"{m.frames_tracked} of {m.frames}", "frames tracked", ", ".join(notes)))
    else:
        T = tracked.estimate.T_world_depth
        length = float(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum())
        many = f"{len(T)} of {frames}" if frames else str(len(T))
        cards += [Card(many, "poses"), Card(f"{number(length)} m", "length of the path")]
    median = _of(info, "timings").get("median_ms")
    if isinstance(median, int | float):
        cards.append(Card(f"{number(median)} ms", "to track a frame (median)"))
    return *rows, CardRow(tuple(cards))


def _errors(m: Metrics) -> tuple[Card, ...]:
    return (
        Card(f"{number(m.ate_rmse_m, 1e3)} mm", "position error (ATE, RMSE)", f"{number(m.ate_max_m, 1e3)} mm at most"),
        Card(f"{number(m.rpe_trans_rmse_m_per_s, 1e3)} mm/s", "drift in translation (RPE, RMSE)"),
        Card(f"{number(m.rpe_rot_rmse_deg_per_s)} °/s", "drift in rotation (RPE, RMSE)"),
    )


def _subtitle(tracked: Tracked) -> str:
    stamps = tracked.estimate.stamps
    text = f"{len(stamps)} poses over {stamps[-1] - stamps[0]:.1f} s"
    if tracked.dataset is not None:
        rig = tracked.dataset.rig
        shutters = " and ".join(
            f"{name} {camera.width}×{camera.height}, "
            + ("global shutter" if shutter.readout_s == 0 else f"{1e3 * shutter.readout_s:g} ms readout")
            for name, camera, shutter in (
                ("colour", rig.color_camera, rig.color_shutter), ("depth", rig.depth_camera, rig.depth_shutter),
            )
        )  # fmt: skip
        text += f"; {shutters}"
    return text


def _facts(info: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """Settings, machine and versions as run.json has them."""
    dataset, noise = _of(info, "dataset"), _of(info, "noise")
    facts = [
        ("method", info.get("method")),
        ("frames", ":".join(str(n) for n in dataset.get("frames") or ())),
        ("keyframes", info.get("keyframes")),
        ("loops", _loops(info)),
        ("refined", _refined(info)),
        ("added noise", _listed({k: v for k, v in noise.items() if v and k != "seed"})),
        ("settings", _listed({k: v for k, v in _of(info, "options").items() if k != "method"})),
        ("backend", info.get("backend")),
        ("machine", _listed(_of(info, "machine"))),
        ("versions", _listed(_of(info, "versions"))),
    ]
    return tuple((name, str(value)) for name, value in facts if value not in (None, ""))


def _loops(info: dict[str, Any]) -> str:
    """What became of the places that the camera came back to; '' where they were not looked for."""
    loops = _of(info, "loops")
    if not loops:
        return ""
    before = _of(info, "metrics_online").get("ate_rmse_m")
    was = f"; ATE before {number(before, 1e3)} mm" if isinstance(before, int | float) else ""
    return f"{loops.get('count', 0)} closed, {loops.get('refused', 0)} refused{was}"


def _refined(info: dict[str, Any]) -> str:
    rounds = _of(info, "refined").get("rounds")
    if not isinstance(rounds, list):
        return ""
    moved = ", ".join(number(r["moved_m"], 1e3) for r in rounds if isinstance(r, dict) and "moved_m" in r)
    return f"{len(rounds)} rounds, which moved poses by up to {moved} mm"


def _listed(values: dict[str, Any]) -> str:
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in values.items())


def _of(info: dict[str, Any], key: str) -> dict[str, Any]:
    value = info.get(key)
    return value if isinstance(value, dict) else {}
