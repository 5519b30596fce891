"""The page of a calibration: its numbers, what it says loudly, and what it is read from."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_util import NASTY, Parsed, calibration, make_run, make_sequence, parse, write_calibration

from rsgen.errors import UserError
from rstrack.calibration.record import CALIBRATION, read_record
from rstrack.cli.main import main
from rstrack.report.build import write_report
from rstrack.report.calibration import strip_chart


def page(folder: Path, data: dict[str, Any]) -> Parsed:
    return parse(write_report(write_calibration(folder, data)))


# ---------------------------------------------------------------------------------------------------------------------


def test_values_stand_beside_their_starts_in_units_that_are_read(tmp_path: Path) -> None:
    shown = page(tmp_path, calibration())
    assert shown.row("depth readout") == ["depth readout", "27.957", "0.044", "0.000", "+27.957", "ms"]
    assert shown.row("colour from depth, about z")[1:] == ["-0.14", "0.12", "0.00", "-0.14", "deg"]
    assert shown.row("depth, mm") == ["depth, mm", "8.00", "2.00", "-75 %"]
    assert shown.row("intensity, % of white")[1:] == ["4.00", "1.00", "-75 %"]
    change, strips = shown.figures
    assert [trace["x"] for trace in change["data"]] == [[27.957, -0.5], [0.0], [-0.14]]
    assert change["data"][0]["error_x"]["array"][0] == pytest.approx(0.044)
    assert change["data"][1]["y"] == ["colour drift"] and "error_x" not in change["data"][1]
    # Two windows, seen from 1 to 2 s and from 3 to 5 s: what lies between is empty.
    cells = strips["data"][0]
    assert cells["x"] == [1.0, 2.0, 3.0, 5.0]
    assert cells["z"][0] == [25.0, None, 75.0] and len(cells["z"]) == 3
    assert {trace["name"] for trace in strips["data"][1:]} == {"speed", "turning"}
    assert max(v for v in strips["data"][2]["y"] if v) == pytest.approx(np.degrees(0.5), rel=1e-3)


def test_a_lens_is_drawn_by_where_it_puts_points(tmp_path: Path) -> None:
    points = [[0.0, 0.0], [40.0, 0.0], [0.0, 40.0], [40.0, 40.0]]
    moved = [[4.0, 0.0], [0.0, -8.0], [2.0, 2.0], [0.0, 0.0]]
    lens = {"at_px": points, "moved_px": moved, "sigma_px": [[0.1], [0.2], [0.3], [0.4]]}
    figure = page(tmp_path, calibration() | {"lens_maps": {"colour": lens}}).figures[1]
    lines, dots = figure["data"]
    # Five times as long as they are, so that the longest reaches the next point.
    assert lines["x"] == [0, 20, None, 40, 40, None, 0, 10, None, 40, 40, None]
    assert lines["y"] == [0, 0, None, 0, -40, None, 40, 50, None, 40, 40, None]
    assert dots["marker"]["color"] == [0.2, 0.4, 0.6, 0.8] and dots["text"][1] == "8.00 ± 0.40 px"
    assert figure["layout"]["yaxis"]["autorange"] == "reversed"


def test_curves_are_broken_where_the_track_was_lost(tmp_path: Path) -> None:
    data = calibration()
    data["pace"] = {"time_s": [0, 0.1, 0.2, 3.0, 3.1], "m_s": [1] * 5, "rad_s": [0] * 5}
    speed = strip_chart(read_record(write_calibration(tmp_path, data))).figure["data"][-2]
    assert [v is None for v in speed["y"]] == [False, False, False, True, False, False]


def test_the_camera_file_is_there_to_copy_and_to_save(tmp_path: Path) -> None:
    data = calibration()
    data["camera_file"] = f"# {NASTY}\ncolor:\n  width: 640\n"
    shown = page(tmp_path, data)
    assert data["camera_file"] in shown.text
    uri = next(v for tag, name, v in shown.attributes if (tag, name) == ("a", "href") and v.startswith("data:"))
    assert base64.b64decode(uri.partition(",")[2]).decode() == data["camera_file"]
    assert ("a", "download", "camera.yaml") in shown.attributes


@pytest.mark.parametrize(
    ("changed", "said", "verdict"),
    [
        ({}, "Converged", "good"),
        ({"converged": False}, "Not converged: the last step still moved", "bad"),
        ({"converged": False, "finished": False}, "Interrupted before it had converged", "bad"),
    ],
)
def test_whether_it_converged_is_said_at_the_top(tmp_path: Path, changed: Any, said: str, verdict: str) -> None:
    shown = page(tmp_path, calibration() | changed)
    assert said in shown.text[: shown.text.index("Found, and where it began")]
    first = next(v for tag, name, v in shown.attributes if (tag, name) == ("div", "class") and v.startswith("card "))
    assert first == f"card {verdict}"
    assert ("do not use this file" in shown.text) == (verdict == "bad")


def test_what_is_undetermined_is_named_with_what_it_needs(tmp_path: Path) -> None:
    shown = page(tmp_path, calibration())
    assert "This recording does not determine colour drift" in shown.text and "3 of 4" in shown.text
    assert shown.row("colour drift") == ["colour drift", "undetermined", "–", "0", "kept", "ms"]
    needs = [row for row in shown.rows if row[0] == "colour drift"][1]
    assert needs[-1] == "motion that changes" and needs[2] == "2.0 ms"
    data = calibration()
    del data["parameters"]["color.drift"]
    assert "does not determine" not in page(tmp_path, data).text
    for name in data["parameters"]:
        data["parameters"][name] |= {"sigma": None, "state": "undetermined", "told_by_stretch": [0.0, 0.0]}
    shown = page(tmp_path, data)
    assert "0 of 3" in shown.text and all(trace["type"] != "heatmap" for trace in shown.figures[1]["data"])


def test_plotly_knows_every_property_of_the_figures(tmp_path: Path) -> None:
    from plotly.graph_objects import Figure  # type: ignore[import-untyped]

    for figure in page(tmp_path, calibration()).figures:
        Figure(figure)  # raises ValueError for a wrong name or value


def test_a_run_that_was_calibrated_shows_it(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", make_sequence(tmp_path / "sequence"))
    assert "Camera file" not in parse(write_report(run)).text
    write_calibration(run, calibration() | {"converged": False})
    shown = parse(write_report(run))
    assert shown.row("depth readout")[1] == "27.957"
    assert "Calibration: not converged" in shown.text[: shown.text.index("Errors against")]
    assert ("section", "id", "calibration") in shown.attributes


def test_what_is_not_a_calibration_is_refused_in_one_line(tmp_path: Path) -> None:
    path = write_calibration(tmp_path, {**calibration(), "stretches": [[0, 30]]})
    with pytest.raises(UserError, match="there are 1 stretches") as error:
        write_report(path)
    assert "\n" not in str(error.value)
    path.write_text(json.dumps({k: v for k, v in calibration().items() if k != "residuals"}))
    with pytest.raises(UserError, match=r"calibration\.json: residuals.*run 'rstrack calibrate --json' again"):
        write_report(path)
    with pytest.raises(UserError, match="leave --sequence"):
        write_report(path, tmp_path)
    path.unlink()
    with pytest.raises(UserError, match="cannot be read"):
        write_report(path)


def test_the_command_writes_the_page_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_calibration(tmp_path, calibration())
    assert main(["report", str(path), "--quiet"]) == 0
    assert (tmp_path / "calibration.html").is_file() and path.name == CALIBRATION
    assert main(["report", str(tmp_path / "gone.json"), "--quiet"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
