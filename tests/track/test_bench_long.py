"""`rstrack bench-long`: blocks of frames, over and over."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import synthetic

from rsgen.errors import UserError
from rstrack.bench import long
from rstrack.bench.long import Block, LongRun, long_run
from rstrack.cli.main import main
from rstrack.data.dataset import open_dataset
from rstrack.options import Options


def test_frames_are_fed_over_and_over_and_counted_in_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stream = {"readout_s": 0.02}
    config = synthetic.make_config(width=80, height=60, color=stream, depth=stream)
    root = synthetic.make_sequence(tmp_path / "seq", config, 10)
    monkeypatch.setattr(long, "BLOCK", 8)
    options = Options(method="rs-g", bootstrap_frames=3, backend="llvm")
    found = long_run(open_dataset(root), options, 26, loop=8)
    # 24 frames: the ninth and the 17th are far from where the last one was, and are believed a frame later.
    assert len(found.blocks) == 3 and found.loop == 8
    assert all(block.median_ms > 0.0 and block.keyframes > 0 and block.peak_bytes > 5e7 for block in found.blocks)
    assert found.blocks[0].lost == 0 and all(block.lost <= 3 for block in found.blocks[1:])
    assert main(["bench-long", str(root), "--frames", "16", "--method", "rs-g", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["blocks"]) == 2
    with pytest.raises(UserError, match="--frames 15: give 16 or more"):
        long_run(open_dataset(root), options, 15)


def test_the_last_block_is_compared_with_the_second() -> None:
    blocks = tuple(Block(ms, ms, k, k, 10**8) for k, ms in enumerate((90.0, 20.0, 21.0, 22.0)))
    run = LongRun("room", "rs-g", 61, blocks)
    assert run.ratio == pytest.approx(1.1)
    text = run.text()
    assert "3000 to 3999" in text and "1.10 times" in text and "4000 frames, 61 over and over" in text
    assert run.as_dict()["blocks"][3]["median_ms"] == 22.0
