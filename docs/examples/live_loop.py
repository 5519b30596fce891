"""Does a tracker keep up with a camera? A recording's frames by the wall clock; what comes while it is busy waits.

    python docs/examples/live_loop.py out/lr_kt2 --method rs-g --hz 30

A start takes longer than the camera's period, and most frames take less: those that arrive meanwhile wait, and the
tracker catches up. Beyond --queue waiting frames every second one is skipped, beyond twice that two of three: the
camera moves less between those that are left than if only the newest were kept (--queue 1). Frames are decoded before
the clock starts, and kernels compiled.

Without --budget-ms the clock decides which frames survive, and nothing else: the survivors fed again without a clock
give the same bits (--check).
"""

from __future__ import annotations

import argparse
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from rstrack import Frame, Options
from rstrack.data.dataset import open_dataset
from rstrack.tracking.any_tracker import AnyTracker, make_tracker

# Frames of another tracker before the clock starts: kernels are compiled when they are first called.
WARM_UP = 20


def survivors(
    count: int, hz: float, clock: Callable[[], float], sleep: Callable[[float], None], queue: int = 1
) -> Iterator[tuple[int, float]]:  # fmt: skip
    """Numbers of the frames that are not dropped, and when each arrived, s: in order, waited for if need be.

    clock, sleep: as of `time`, in s. Between two numbers the caller works, and frames go on arriving. Where more than
    `queue` frames wait one is skipped for each that is taken, where more than twice as many wait two, and so on.
    """
    begin, arrived, waiting = clock(), 0, deque[int]()
    while arrived < count or waiting:
        if not waiting:
            sleep(max(begin + arrived / hz - clock(), 0.0))
        newest = min(max(int((clock() - begin) * hz), arrived - bool(waiting)) + 1, count)
        waiting += range(arrived, newest)
        arrived = newest
        for _ in range((len(waiting) - 1) // queue):
            waiting.popleft()
        n = waiting.popleft()
        yield n, begin + n / hz


def live(
    tracker: AnyTracker, camera: Callable[[int], Frame], count: int, hz: float,
    clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep, queue: int = 1,
) -> tuple[list[int], np.ndarray]:  # fmt: skip
    """Numbers (n,) of the frames that were tracked, and the seconds (n,) from each one's arrival to its pose."""
    fed, latencies = [], []
    for n, arrived in survivors(count, hz, clock, sleep, queue):
        tracker.feed(camera(n))
        fed.append(n)
        latencies.append(clock() - arrived)
    return fed, np.array(latencies)


def main(
    words: list[str] | None = None, clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> None:  # fmt: skip
    """Print how many frames came and were dropped, and how late poses were."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "recording", type=Path, help="a folder that rstrack track takes; 2 MB of memory a 640x480 frame"
    )
    parser.add_argument("--camera", type=Path, help="camera file, as of rstrack track")
    parser.add_argument("--method", default="rs-pg", help="one without an IMU")
    parser.add_argument("--seconds", type=float, default=np.inf, help="by the clock (default: the whole recording)")
    parser.add_argument("--hz", type=float, default=30.0, help="frames a second that the clock says have arrived")
    parser.add_argument("--queue", type=int, default=30, help="frames that may wait before some are skipped")
    parser.add_argument(
        "--budget-ms", type=float, help="of a frame, as of rstrack track; poses depend on the clock then"
    )
    parser.add_argument("--check", action="store_true", help="feed the survivors again without a clock: the same bits?")
    given = parser.parse_args(words)
    if given.queue < 1:
        parser.error(f"--queue {given.queue}: one frame at least has to wait")

    dataset = open_dataset(given.recording, given.camera)
    count = int(min(len(dataset.stamps), given.seconds * given.hz))
    frames, interval_s = list(dataset.frames(0, count)), dataset.interval_s(range(count))

    def new() -> AnyTracker:
        return make_tracker(dataset.rig, Options(method=given.method, budget_ms=given.budget_ms), interval_s=interval_s)

    warm = new()
    for frame in frames[:WARM_UP]:
        warm.feed(frame)
    tracker = new()
    fed, seconds = live(tracker, frames.__getitem__, count, given.hz, clock, sleep, given.queue)
    lost, cut = (sum(getattr(report, name) for report in tracker.reports) for name in ("lost", "is_cut"))
    told = f"{len(fed)} fed, {count - len(fed)} dropped, {lost} lost, {cut} cut short"
    print(f"{count} frames in {count / given.hz:.1f} s: {told}")
    for name, after in (("", 0.0), (" from 3 s on", 3.0)):
        late = 1e3 * seconds[np.array(fed) >= after * given.hz]
        if len(late):
            median, p95, p99 = np.percentile(late, [50, 95, 99])
            print(f"latency{name}, ms: median {median:.1f}, 95 % {p95:.1f}, 99 % {p99:.1f}, worst {late.max():.1f}")
    if given.check:
        again = new()
        for n in fed:
            again.feed(frames[n])
        same = np.array_equal(tracker.trajectory[1], again.trajectory[1])
        print("fed again without a clock: " + ("the same bits" if same else "OTHER POSES"))


if __name__ == "__main__":
    main()
