"""What a tracking run came to, and the few lines that it ends with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from rstrack.data.estimate import Estimate
from rstrack.data.timing import Timing
from rstrack.metrics.evaluate import Metrics
from rstrack.metrics.run_evaluate import RunEvaluation

End = Literal["done", "interrupted", "broke down"]

# Observability (see FrameReport) below which a motion is held by the prior rather than by depth.
_WEAK = 5e-4


@dataclass(frozen=True)
class Result:
    """What a run came to.

    end: why it stopped; `error` says where the tracker broke down. evaluation: None without a truth, or with too few
    poses. lost: number of frames. unreadable: what was wrong with each image that was left out; where that was a depth
    image, its frame was. timing: of recordings, how stamps came about. loops, imu, segments: a line each.
    """

    estimate: Estimate
    evaluation: RunEvaluation | None
    end: End
    error: str
    lost: int
    unreadable: tuple[str, ...] = ()
    timing: Timing | None = None
    loops: str = ""
    imu: str = ""
    segments: str = ""

    @property
    def metrics(self) -> Metrics | None:
        """Errors with the truth's clock as it is."""
        return None if self.evaluation is None else self.evaluation.metrics

    def text(self) -> str:
        """A summary of a few lines, with the metrics if there is a truth."""
        info, times = self.estimate.info, self.estimate.info["timings"]
        done, asked = len(info["frames"]), info["dataset"]["frames"][1] - info["dataset"]["frames"][0]
        part = f"{done} frames" if done == asked else f"{done} of {asked} frames"
        lost = f"{self.lost} lost" if self.lost else "none lost"
        rate = done / times["total_s"]
        lines = [
            f"{info['method']} on {info['dataset']['name']}: {part}, {keyframes_text(info['keyframes'])}, {lost}",
            f"{times['total_s']:.1f} s, {rate:.1f} frames/s on {info['backend']}; a frame takes "
            f"{times['median_ms']:.1f} ms (median), {times['mean_ms']:.1f} (mean), {times['p95_ms']:.1f} (95 %)",
        ]
        lines += [why] if (why := _faults_text(info["frames"])) else []
        lines += [line for line in (self.segments, self.loops, self.imu) if line]
        weak = sum(not f["lost"] and 0.0 < f["observability"] < _WEAK for f in info["frames"])
        if weak and info["method"] in ("rs-g", "gs-g", "baseline"):
            lines.append(f"in {weak} of {done} frames the geometry hardly fixes all six degrees of freedom (a wall?)")
        if self.unreadable:
            images = "1 image" if len(self.unreadable) == 1 else f"{len(self.unreadable)} images"
            lines.append(f"left out: {images} that cannot be read, first {self.unreadable[0]}")
        if info.get("checkpoint_error"):
            lines.append(f"cannot be resumed: {info['checkpoint_error']}")
        lines += [f"assumed: {note}" for note in info["dataset"].get("notes", ())]
        lines += [] if self.timing is None else self.timing.lines()
        if late := info.get("color_late"):
            seconds, sigma_s = (1e3 * late[name] for name in ("seconds", "sigma_s"))
            lines.append(f"colour: found to be {seconds:+.1f} ± {sigma_s:.1f} ms later than that while tracking")
        return "\n".join(lines + ([] if self.evaluation is None else ["", self.evaluation.text()]))


def _faults_text(frames: Sequence[dict[str, Any]]) -> str:
    """Why frames were lost, most frequent reason first."""
    faults = Counter(f["fault"] for f in frames if f["lost"])
    return "lost because: " + "; ".join(f"{why} ({count})" for why, count in faults.most_common()) if faults else ""


def keyframes_text(count: int) -> str:
    """So many keyframes, in words."""
    return f"{count} keyframe" + ("" if count == 1 else "s")
