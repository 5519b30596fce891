"""The section `faults` of a config: former names are answered with the new ones, and recordings keep their own."""

from __future__ import annotations

from pathlib import Path

import pytest
from config_files import MINIMAL, load, refused

from rsgen.cli.main import main
from rsgen.config.config import recorded_config


@pytest.mark.parametrize(
    ("old", "now"),
    [
        ("declared.color.readout_s", "faults.declared"),
        ("color.driver.jitter_s", "faults.color"),
        ("depth.driver", "faults.depth"),
        ("imu.clock_offset_s", "faults.imu.clock_offset_s"),
    ],
)
def test_a_fault_by_its_former_name_is_told_the_new_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, now: str
) -> None:
    named = "declared" if "declared" in old else ".".join(old.split(".")[:2])
    refused(tmp_path, MINIMAL, f"{named}: is now {now}", overrides={old: "1"})
    assert main(["render", "demo", f"--{old}", "1"]) == 2
    assert f"rsgen: --{old}: is now --{now}" in capsys.readouterr().err


def test_a_recorded_config_keeps_its_faults_under_their_former_names(tmp_path: Path) -> None:
    faults = {"color": {"blackouts": [[1.0, 0.5]]}, "imu": {"dropped": 0.0}, "declared": {"depth": {"readout_s": 0.01}}}
    config = load(tmp_path, MINIMAL | {"imu": {"preset": "phone"}, "faults": faults})
    content = config.content()
    assert "faults" not in content and content["color"]["driver"]["blackouts"] and content["depth"]["driver"] is None
    assert content["imu"]["jitter_s"] == 5e-5 and content["declared"]["depth"]["readout_s"] == 0.01
    again = recorded_config(content, "again")
    assert again.content() == content and again.injected.imu == config.injected.imu  # none of the preset's losses
