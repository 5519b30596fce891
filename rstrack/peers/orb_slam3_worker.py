"""ORB-SLAM3 in a process of its own (it is GPL, prints much, and may end the process): frames in, a trajectory out.

python -m rstrack.peers.orb_slam3_worker FOLDER

FOLDER holds vocabulary.txt, settings.yaml and, in the order of their names, NUMBER.npz with stamp (s), gray (h, w)
uint8 and depth (h, w) float32 in m, as `rstrack.peers.orb_slam3` writes them. Written there: final.txt, its trajectory
(TUM) once mapping has ended, and frames.npz with what each frame took (ms) and whether it was tracked.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np


def work(folder: Path, module: Any) -> None:
    """Track the frames of a folder with the module pyorbslam3, no faster than they were taken: mapping needs time."""
    slam = module.Slam(str(folder / "vocabulary.txt"), str(folder / "settings.yaml"), module.Sensor.RGBD)
    ms: list[float] = []
    tracked: list[bool] = []
    start = first = 0.0
    for path in sorted(folder.glob("[0-9]*.npz")):
        with np.load(path) as frame:
            stamp, gray, depth = float(frame["stamp"]), frame["gray"], frame["depth"]
        begin = time.perf_counter()
        start, first = (start, first) if ms else (begin, stamp)
        time.sleep(max(0.0, (stamp - first) - (begin - start)))
        begin = time.perf_counter()
        tracked.append(bool(slam.track_rgbd(gray, depth, stamp).ok))
        ms.append(1e3 * (time.perf_counter() - begin))
    slam.shutdown()
    if any(tracked):
        slam.save_trajectory_tum(str(folder / "final.txt"))
    np.savez(folder / "frames.npz", ms=np.array(ms), tracked=np.array(tracked))


if __name__ == "__main__":
    import pyorbslam3

    work(Path(sys.argv[1]), pyorbslam3)
