"""Drivers' listings: stamps of arrival against their formula, losses and repetitions, and whole sequences of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny
from pydantic import ValidationError

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.faults import StreamFaults
from rsgen.image_codecs import read_png
from rsgen.sensors.reports import deliver
from rsgen.sequence.reader import read_sequence

STAMPS = 2.0 + np.arange(3000) / 30.0
FRAMES = 24


def listed(**settings: float) -> np.ndarray:
    return deliver(STAMPS, StreamFaults(**settings), 4, "color").listed


def test_without_a_driver_all_is_as_it_is() -> None:
    came = deliver(STAMPS, None, 4, "color")
    assert came.listed is STAMPS and came.is_delivered.all() and (came.shows == np.arange(len(STAMPS))).all()


def test_offset_and_drift_make_a_line() -> None:
    late = listed(offset_s=0.02, drift_ppm=300.0) - STAMPS
    slope, first = np.polyfit(STAMPS - STAMPS[0], late, 1)
    assert slope == pytest.approx(300e-6, rel=1e-4) and first == pytest.approx(0.02, abs=1e-7)


def test_jitter_has_its_size_and_stamps_rise() -> None:
    late = listed(jitter_s=0.002) - STAMPS
    assert late.std() == pytest.approx(0.002, rel=0.05) and abs(late.mean()) < 2e-4
    crowded = listed(jitter_s=0.2)
    assert np.diff(crowded).min() > 5e-7 and np.abs(crowded - STAMPS).std() > 0.05


def test_a_grid_keeps_the_mean_delay_and_adds_its_own_jitter() -> None:
    stamps = listed(grid_s=0.004, offset_s=0.0123)
    assert np.abs(stamps / 0.004 - np.rint(stamps / 0.004)).max() < 1e-5
    late = stamps - STAMPS
    # 33.3 ms is no multiple of 4 ms: the rounding error is spread over the step, uniformly enough over 3000 frames.
    assert late.mean() == pytest.approx(0.0123, abs=5e-4)
    assert set(np.rint(np.diff(stamps) * 1e3)) == {32.0, 36.0}


def test_two_images_never_share_a_step_of_the_grid() -> None:
    stamps = listed(grid_s=0.02, jitter_s=0.02)
    assert np.diff(np.rint(stamps / 0.02)).min() == 1


def test_losses_and_repetitions_have_their_share_and_show_an_earlier_image() -> None:
    came = deliver(STAMPS, StreamFaults(dropped=0.1, repeated=0.05), 4, "color")
    frames = np.arange(len(STAMPS))
    again = came.is_delivered & (came.shows != frames)
    # Binomial: standard deviations 0.55 % and 0.4 % of 3000.
    assert (~came.is_delivered).mean() == pytest.approx(0.1, abs=0.02)
    assert again.mean() == pytest.approx(0.05, abs=0.016)
    for k in np.flatnonzero(again):
        before = [j for j in range(k) if came.is_delivered[j] and came.shows[j] == j]
        assert came.shows[k] == before[-1]


def test_fates_depend_on_seed_stream_and_number_only() -> None:
    config = StreamFaults(dropped=0.2, jitter_s=0.003)
    whole, part = deliver(STAMPS, config, 4, "color"), deliver(STAMPS[:100], config, 4, "color")
    assert (whole.listed[:100] == part.listed).all() and (whole.is_delivered[:100] == part.is_delivered).all()
    for seed, stream in ((5, "color"), (4, "depth")):
        assert (deliver(STAMPS, config, seed, stream).is_delivered != whole.is_delivered).any()  # type: ignore[arg-type]


def test_nearly_all_lost_is_refused() -> None:
    with pytest.raises(ValidationError, match="together at most"):
        StreamFaults(dropped=0.5, repeated=0.5)


# --- whole sequences


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    lossy = {"dropped": 0.15, "repeated": 0.15, "offset_s": 0.03, "jitter_s": 0.002, "grid_s": 0.004}
    return tiny.write_config(
        tmp_path_factory.mktemp("driver"),
        FRAMES,
        color={"noise": {"model": "camera"}},
        faults={"color": lossy, "depth": lossy | {"drift_ppm": -500.0}},
        truth={"flow": ["next"]},
    )


@pytest.fixture(scope="module")
def whole(config: Path) -> Path:
    out = config.parent / "whole"
    assert main(["render", str(config), "--out", str(out), "--quiet"]) == 0
    return out


def test_a_lossy_sequence_verifies_and_keeps_true_times(whole: Path) -> None:
    report = verify_sequence(whole)
    assert report.ok, report.text()
    for stream in read_sequence(whole).streams.values():
        assert stream.table is not None and 0 < len(stream.paths) < FRAMES
        assert (np.diff(stream.listed) > 0).all() and (np.diff(stream.stamps) == 0).any()
        assert np.allclose(stream.stamps, stream.table.shows / 30.0, atol=1e-8)
        late = stream.listed - stream.table.frame / 30.0
        assert late.mean() == pytest.approx(0.03, abs=0.003) and np.ptp(late) > 0.002


def test_a_repeated_image_is_the_one_before_bit_for_bit(whole: Path) -> None:
    color = read_sequence(whole).streams["color"]
    assert color.table is not None
    repeated = np.flatnonzero(color.table.shows != color.table.frame)
    for k in repeated:
        first = list(color.table.shows).index(color.table.shows[k])
        assert color.paths[k].read_bytes() == color.paths[first].read_bytes()
        np.testing.assert_array_equal(read_sequence(whole).rows("color")[k], read_sequence(whole).rows("color")[first])


def test_flow_leads_to_the_next_image_that_is_listed(whole: Path) -> None:
    sequence = read_sequence(whole)
    color = sequence.streams["color"]
    sizes = np.array([np.abs(sequence.truth("flow_next", k)[..., :2]).mean() for k in range(len(color.paths))])
    gaps = np.diff(color.stamps)
    same, next_one, farther = gaps == 0, (gaps > 0) & (gaps < 0.05), gaps > 0.05
    assert sizes[:-1][same].max() < 1e-3 < sizes[:-1][next_one].min() and sizes[-1] == 0
    assert np.median(sizes[:-1][farther]) > 1.4 * np.median(sizes[:-1][next_one])


def test_images_are_those_of_the_same_config_without_a_driver(config: Path, whole: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    words = ["--faults", "null", "--frames", "0:6"]
    assert main(["render", str(config), "--out", str(plain), "--quiet", *words]) == 0
    lossy, exact = read_sequence(whole), read_sequence(plain)
    assert not (plain / "truth/frames_color.txt").exists()
    table = lossy.streams["color"].table
    assert table is not None
    for k in np.flatnonzero(table.shows < 6):
        shown = exact.streams["color"].paths[table.shows[k]]
        np.testing.assert_array_equal(lossy.color(int(k)), read_png(shown, (36, 48, 3), np.uint8))


def test_resuming_gives_the_same_bytes(config: Path, whole: Path, tmp_path: Path) -> None:
    for frames in ("12:", "0:12"):
        assert main(["render", str(config), "--out", str(tmp_path / "seq"), "--frames", frames, "--quiet"]) == 0
    assert tiny.digests(tmp_path / "seq") == tiny.digests(whole)


def test_a_table_that_is_damaged_or_foreign_is_named(whole: Path) -> None:
    path = whole / "truth/frames_color.txt"
    text = path.read_text()
    lines = text.splitlines()
    try:
        for damaged in (
            "",
            "\n".join([lines[0], *lines[2:]]),
            text.replace(" 1 ", " x ", 1),
            text.replace("0.0", "0.1"),
        ):
            path.write_text(damaged)
            report = verify_sequence(whole)
            named = "frames_color.txt" in report.text() or "rgb.txt line" in report.text()
            assert not report.ok and named, report.text()
    finally:
        path.write_text(text)
