"""A baseline of VSLAM-LAB: rstrack. Copy to VSLAM-LAB/Baselines/baseline_files/.

The command is `pixi run -e rstrack execute-rgbd ...`, which runs `vslamlab_rstrack_rgbd.py`: see README.md here.
"""

from __future__ import annotations

from typing import Any

from Baselines.BaselineVSLAMLab import BaselineVSLAMLab


class RSTRACK_baseline(BaselineVSLAMLab):
    """rstrack on depth and colour; `method` is one of `rstrack track --method`."""

    def __init__(self, baseline_name: str = "rstrack", baseline_folder: str = "RSTRACK") -> None:
        super().__init__(baseline_name, baseline_folder, {"verbose": 0, "mode": "rgbd", "method": "rs-pg"})
        self.color = (0.85, 0.33, 0.12)
        self.modes = ["rgbd"]
        self.camera_models = ["pinhole", "radtan4", "radtan5", "equid4"]

    def build_execute_command(self, exp_it: int, exp: Any, dataset: Any, sequence_name: str) -> str:
        """As of all baselines in Python."""
        command: str = super().build_execute_command_python(exp_it, exp, dataset, sequence_name)
        return command

    def git_clone(self) -> None:
        """Nothing to clone: the script is copied into Baselines/RSTRACK, the package is in the environment."""

    def is_installed(self) -> tuple[bool, str]:
        """Whether the script is where pixi.toml runs it."""
        is_there = (self.baseline_path / "vslamlab_rstrack_rgbd.py").is_file()
        return is_there, "is installed" if is_there else f"not installed (copy its script to {self.baseline_path})"
