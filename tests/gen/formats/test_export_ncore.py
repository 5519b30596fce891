"""NCore files, read back by NVIDIA's own library, which has to be installed for that (it brings PyTorch)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic

from rsgen.errors import UserError
from rsgen.formats.export import poses
from rsgen.formats.export.ncore import ENDS, export_ncore, frame_times_us
from rsgen.formats.export.poses import Observations, observations
from rsgen.formats.export.shared import EPOCH_S
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence

LENSES: dict[str, list[float]] = {
    "pinhole": [],
    "radtan": [-0.05, 0.02, 0.001, -0.002],
    "rational": [0.1, -0.02, 0.001, -0.002, 0.003, 0.15, -0.01, 0.002],
    "fisheye": [0.02, -0.01, 0.003, -0.001],
}


def make(folder: Path, **color: Any) -> Sequence:
    wide = [34.0, 34.0, 31.5, 23.5]  # so that depth tells points on all of colour's lines
    depth = {"readout_s": 0.02, "offset_s": 0.004, "rate_hz": 15.0, "intrinsics": wide}
    return read_sequence(synthetic.make_sequence(folder / "seq", synthetic.make_config(color=color, depth=depth), 4))


@pytest.mark.parametrize("scan", ["top-bottom", "bottom-top", "left-right", "right-left"])
@pytest.mark.parametrize("model", LENSES)
def test_every_line_is_where_the_library_looks_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str, scan: str
) -> None:
    v4 = pytest.importorskip("ncore.data.v4")
    sensors = pytest.importorskip("ncore.sensors")
    torch = pytest.importorskip("torch")
    sequence = make(tmp_path, model=model, distortion=LENSES[model], scan=scan, exposure_s=0.01)
    said = export_ncore(sequence, tmp_path / "out")
    assert "4 colour and 4 depth images" in said and ENDS in said
    (path,) = (tmp_path / "out").iterdir()
    loader = v4.SequenceLoaderV4(v4.SequenceComponentGroupsReader([path]))
    assert sorted(loader.camera_ids) == ["color", "depth"]
    camera, color = loader.get_camera_sensor("color"), sequence.streams["color"]
    lens = sensors.CameraModel.from_parameters(camera.model_parameters, device="cpu", dtype=torch.float64)
    for k in range(4):
        pixels = np.asarray(camera.get_frame_handle(k).get_data().get_decoded_image())
        np.testing.assert_array_equal(pixels, sequence.color(k))
        assert camera.get_frame_generic_meta_data(k)["stamp_s"] == color.stamps[k]
    units = np.asarray(loader.get_camera_sensor("depth").get_frame_handle(1).get_data().get_decoded_image())
    np.testing.assert_array_equal(units, sequence.depth_units(1))

    # Scene points, at the time that the library gives the line on which each is seen.
    monkeypatch.setattr(poses, "_COLUMNS", 64)
    seen, times = observations(sequence), camera.frames_timestamps_us.astype(float)
    line = color.shutter.line_of_pixel(seen.uv, color.camera)
    # Half of the first line's pixels, and of the last's, are beyond their middle: no image is taken then.
    kept = (line >= 0) & (line <= color.line_count - 1)
    seen = Observations(seen.p_world[kept], seen.uv[kept], seen.t[kept], seen.image[kept])
    line = line[kept]
    part = line / (color.line_count - 1)
    at = np.rint(times[seen.image, 0] * (1 - part) + times[seen.image, 1] * part).astype(np.uint64)
    assert np.abs(at * 1e-6 - EPOCH_S - seen.t).max() < 1.5e-6
    T = loader.pose_graph.evaluate_poses("world", "color", at)
    p_color = np.einsum("nij,nj->ni", T[:, :3, :3], seen.p_world) + T[:, :3, 3]
    found = lens.camera_rays_to_image_points(torch.from_numpy(p_color))
    off = np.linalg.norm(found.image_points.numpy() - 0.5 - seen.uv, axis=1)
    lines = np.unique(np.rint(line))
    print(model, scan, "px:", np.median(off), off.max(), "lines:", len(lines), "points:", len(off))
    assert found.valid_flag.numpy().all() and off.max() < 0.01 and len(lines) == color.line_count

    # What its own rolling-shutter projection makes of the two poses of an image is what was said to be lost.
    k = 2
    ends = [loader.pose_graph.evaluate_poses("world", "color", camera.frames_timestamps_us[k, i]) for i in (0, 1)]
    here = seen.image == k
    own = lens.world_points_to_image_points_shutter_pose(
        seen.p_world[here], *ends, max_iterations=30, stop_t_delta=1e-7, return_valid_indices=True
    )
    far = np.linalg.norm(own.image_points.numpy() - 0.5 - seen.uv[here][own.valid_indices.numpy()], axis=1)
    assert np.median(far) < 0.5 and len(far) > 100


def test_times_are_those_of_the_first_and_the_last_line(tmp_path: Path) -> None:
    for scan in ("top-bottom", "right-left"):
        stream = make(tmp_path / scan, scan=scan, exposure_s=0.01).streams["color"]
        begin, end = frame_times_us(stream)[1] * 1e-6 - EPOCH_S
        lines = 48 if scan == "top-bottom" else 64
        assert begin == pytest.approx(stream.stamps[1] - 0.005, abs=1e-6)
        assert end - begin == pytest.approx(0.028 * (lines - 1) / lines, abs=2e-6)


def test_without_the_library_it_is_said_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ncore.data.v4", None)
    with pytest.raises(UserError, match=r"needs nvidia-ncore: pip install .*nvidia-ncore"):
        export_ncore(make(tmp_path), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_damaged_image_leaves_nothing(tmp_path: Path) -> None:
    pytest.importorskip("ncore.data.v4")
    sequence = make(tmp_path)
    sequence.streams["color"].paths[3].write_bytes(b"")
    with pytest.raises(UserError, match="is empty"):
        export_ncore(sequence, tmp_path / "out")
    assert not (tmp_path / "out").exists()
