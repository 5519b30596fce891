"""What the exports share: folders left alone, what others have no words for, the IMU, the example of the docs."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import synthetic
from exported import EPOCH_NS, IMU, T_IMU_DEPTH, load, make_plain, with_color, with_imu

from rsgen import formats
from rsgen.config.config import Config
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rsgen.formats.export import shared
from rsgen.formats.export.euroc import export_euroc
from rsgen.formats.export.kalibr import export_kalibr
from rsgen.formats.export.registered import export_registered
from rsgen.formats.export.shared import place_images
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sensors.imu import exact_imu
from rsgen.sensors.reports import sequence_imu
from rsgen.sequence.format import pose_rows
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return make_plain(tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def sequence(plain: Sequence) -> Sequence:
    """The same with an IMU."""
    return with_imu(plain, IMU)


def test_images_are_copied_where_links_cannot_be(
    plain: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_link(*_: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(shared.os, "link", no_link)
    source = plain.streams["color"].paths[0]
    place_images([source], tmp_path, False, no_progress, ["a.png"])
    assert (tmp_path / "a.png").read_bytes() == source.read_bytes()


EXPORTS: dict[str, Callable[[Sequence, Path], str]] = {
    "kalibr": export_kalibr,
    "euroc": lambda sequence, out: export_euroc(sequence, out.parent),
    "registered": export_registered,
}


@pytest.mark.parametrize("name", EXPORTS)
def test_a_folder_with_anything_in_it_is_left_alone(name: str, sequence: Sequence, tmp_path: Path) -> None:
    out = tmp_path / "mav0"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match=r"is not empty \(mine\.txt, \.\.\.\)"):
        EXPORTS[name](sequence, out)
    assert [path.name for path in out.iterdir()] == ["mine.txt"]
    (out / "mine.txt").unlink()
    EXPORTS[name](sequence, out)
    (tmp_path / "file").mkdir()
    (tmp_path / "file/mav0").write_text("")
    with pytest.raises(UserError, match="is a file"):
        EXPORTS[name](sequence, tmp_path / "file/mav0")


@pytest.mark.parametrize("name", ["kalibr", "euroc"])
def test_what_others_have_no_words_for_is_refused(name: str, sequence: Sequence, tmp_path: Path) -> None:
    camera = Camera(64, 48, 48, 48, 31.5, 23.5, "radtan", (0.0, 0.0, 0.0, 0.0, 0.1))
    with pytest.raises(UserError, match=r"^color: k3 = 0.1 has no place"):
        EXPORTS[name](with_color(sequence, camera=camera), tmp_path / "mav0")
    assert not (tmp_path / "mav0").exists()


def test_sideways_scans_have_no_line_delay(sequence: Sequence, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^color: scan left-right reads columns"):
        export_kalibr(with_color(sequence, shutter=Shutter(0.02, 0.0, "left-right")), tmp_path / "k")
    export_kalibr(with_color(sequence, shutter=Shutter(0.0, 0.01, "left-right")), tmp_path / "k")
    cam0 = load(tmp_path / "k/camchain.yaml")["cam0"]
    assert cam0["line_delay"] == 0.0 and cam0["timeshift_cam_imu"] == -0.005


def test_negative_stamps_are_refused(sequence: Sequence, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be negative"):
        export_euroc(sequence, tmp_path, epoch_s=0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "meta",
    [
        {"config": {"imu": {"rate_hz": "fast"}}},
        {"config": {"imu": {"rate_hz": 5, "colour": 1}}},
        {"config": {"imu": [1, 2]}},
        {"config": {"imu": {}}, "seed": "x"},
        {"config": {"imu": {}}, "seed": None},
        {"config": {"imu": {}}, "seed": -1},
        {"config": {"imu": {"rate_hz": 1e5}}, "seed": 0, "spline": 1e9},
    ],
)
def test_a_broken_imu_entry_is_one_line(meta: dict[str, Any], sequence: Sequence, tmp_path: Path) -> None:
    spline = replace(sequence.spline, dt=meta.get("spline", sequence.spline.dt))
    with pytest.raises(UserError) as error:
        export_kalibr(replace(sequence, meta=meta, spline=spline), tmp_path / "k")
    assert "\n" not in str(error.value) and not (tmp_path / "k").exists()


@pytest.mark.parametrize("meta", [{}, {"config": None}, {"config": 3}, {"config": {"imu": None}}])
def test_no_imu_is_no_imu(meta: dict[str, Any], sequence: Sequence) -> None:
    assert sequence_imu(replace(sequence, meta=meta)) is None


def test_the_sequences_imu_is_over_its_spline(sequence: Sequence) -> None:
    found = sequence_imu(sequence)
    assert found is not None
    config, samples, _ = found
    assert config.rate_hz == 100.0
    assert samples.t[0] == sequence.spline.t_begin and samples.t[-1] > sequence.spline.t_end - 0.0101
    gyro, force = exact_imu(sequence.spline, T_IMU_DEPTH, config.gravity, samples.t)
    assert np.abs(samples.gyro - samples.gyro_bias - gyro).max() < 6 * 1.6968e-4 * 10
    assert np.abs(samples.accel - samples.accel_bias - force).max() < 6 * 2e-3 * 10


def test_the_exported_imu_is_that_of_the_sequences_own_file(tmp_path: Path) -> None:
    config = Config.model_validate(synthetic.make_config().model_dump() | {"imu": IMU, "seed": 11})
    sequence = read_sequence(synthetic.make_sequence(tmp_path / "seq", config, frames=2))
    export_euroc(sequence, tmp_path / "seq")
    own = (tmp_path / "seq/imu.csv").read_text().splitlines()
    exported = (tmp_path / "seq/mav0/imu0/data.csv").read_text().splitlines()
    assert len(own) == len(exported) > 100 and own[0] == exported[0]
    for a, b in zip(own[1:], exported[1:], strict=True):
        (ns_a, readings_a), (ns_b, readings_b) = (line.split(",", 1) for line in (a, b))
        assert int(ns_a) + EPOCH_NS == int(ns_b) and readings_a == readings_b


def test_the_export_of_the_document_is_one_module_and_one_line(
    plain: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """docs/adding-a-format.md: its module runs by its line in the registry."""
    text = (Path(__file__).parents[3] / "docs/adding-a-format.md").read_text()
    code, line, *_ = re.findall(r"^```python\n(.*?)^```$", text, flags=re.M | re.S)
    module = ModuleType("rsgen.formats.export.poses_csv")
    exec(code, module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(formats, "EXPORTS", dict(formats.EXPORTS))
    exec(line, formats.__dict__)
    out = plain.root / f"{plain.name}.csv"
    told = formats.exporter("poses_csv")(plain, plain.root / formats.EXPORTS["poses_csv"][1].format(plain.name))
    assert told == f"{out}: {sum(len(stream.paths) for stream in plain.streams.values())} poses"
    rows = out.read_text().splitlines()[1:]
    depth = plain.streams["depth"]
    times = depth.shutter.line_mid_time(depth.stamps, 0.5 * (depth.line_count - 1), depth.camera)
    expected = pose_rows(plain.spline.pose(times))
    written = np.array([row.split(",")[3:] for row in rows if row.startswith("depth,")], float)
    np.testing.assert_allclose(written, expected, atol=1e-9)
