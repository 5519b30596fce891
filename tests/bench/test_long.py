"""The measure `long`: blocks of frames, over and over."""

from __future__ import annotations

from pathlib import Path

import pytest
import synthetic
from bench_task import make_task

from benchmarks.measures import runs as long
from benchmarks.measures.runs import FrameBlock, figures_of, long_cell
from rsgen.console.progress import no_progress
from rsgen.errors import UserError


def test_frames_are_fed_over_and_over_and_counted_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = {"readout_s": 0.02}
    config = synthetic.make_config(width=80, height=60, color=stream, depth=stream)
    root = synthetic.make_sequence(tmp_path / "seq", config, 10)
    monkeypatch.setattr(long, "BLOCK", 8)
    options = {"bootstrap_frames": 3, "backend": "llvm"}
    found = long_cell(make_task(root, options=options, settings={"frames": 26, "loop": 8}), no_progress)
    # 24 frames: the ninth and the 17th are far from where the last one was, and are believed a frame later.
    assert found["frames"] == 24 and 0 <= found["lost"] <= 6 and found["lost_last"] <= 3
    assert found["ratio"] == pytest.approx(found["median_last_ms"] / found["median_second_ms"])
    assert found["keyframes"] > 0 and found["peak_mb"] >= found["peak_second_mb"] > 50
    with pytest.raises(UserError, match="frames: 15: give 16 or more"):
        long_cell(make_task(root, options=options, settings={"frames": 15}), no_progress)


def test_the_last_block_is_compared_with_the_second() -> None:
    blocks = [FrameBlock(ms, ms + 1, k, k, 100.0 + k) for k, ms in enumerate((90.0, 20.0, 25.0, 22.0))]
    found = figures_of(blocks)
    assert found["ratio"] == pytest.approx(1.1) and found["frames"] == 4000 and found["growth_mb"] == 2.0
    assert found["median_first_ms"] == 90.0 and found["mean_last_ms"] == 23.0 and found["median_worst_ms"] == 25.0
    assert found["lost"] == 6 and found["lost_last"] == found["keyframes"] == 3
