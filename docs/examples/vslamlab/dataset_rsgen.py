"""A dataset of VSLAM-LAB: rolling-shutter sequences of rsgen. Copy to VSLAM-LAB/Datasets/dataset_files/.

`rsgen export vslamlab` writes all that VSLAM-LAB wants of a sequence; nothing is downloaded.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import yaml
from Datasets.DatasetVSLAMLab import DatasetVSLAMLab


class RSGEN_dataset(DatasetVSLAMLab):
    """Sequences are exported from `sequences_root` of dataset_rsgen.yaml into the benchmark's folder."""

    def __init__(self, benchmark_path: str | Path, dataset_name: str = "rsgen") -> None:
        super().__init__(dataset_name, Path(benchmark_path))
        settings = yaml.safe_load(self.yaml_file.read_text(encoding="utf-8"))
        self.sequences_root = Path(settings["sequences_root"])
        self.depth_factor = float(settings["depth_factor"])
        self.sequence_nicknames = [name.replace("_", " ") for name in self.sequence_names]

    def download_sequence_data(self, sequence_name: str) -> None:
        """Export the sequence whole; the steps that follow find their work done."""
        source, out = self.sequences_root / sequence_name, self.dataset_path / sequence_name
        subprocess.run(["rsgen", "export", "vslamlab", source, "--out", out, "--quiet"], check=True)

    def create_rgb_folder(self, sequence_name: str) -> None:
        """Done by the export."""

    def create_rgb_csv(self, sequence_name: str) -> None:
        """Done by the export."""

    def create_calibration_yaml(self, sequence_name: str) -> None:
        """Done by the export."""
