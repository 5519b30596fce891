"""Does a tracker keep up with a camera? A recording's frames by the wall clock; what comes while it is busy is dropped.

    python docs/examples/live_loop.py out/lr_kt2 --method rs-pg --seconds 60 --hz 30

As with a camera, one frame waits at most, and a newer one takes its place. Frames are decoded before the clock starts,
and kernels compiled. A recording that is shorter than that is played forth and back; on the way back the lines of a
rolling shutter run backwards in time as well, so that poses are worse there, and some frames are lost.

Without --budget-ms the clock decides which frames survive, and nothing else: the survivors fed again without a clock
give the same bits (--check).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from rsgen.geometry.shutter import Shutter
from rstrack import Frame, Image, Options, Rig
from rstrack.data.dataset import open_dataset
from rstrack.tracking.any_tracker import AnyTracker, make_tracker

# Frames of another tracker before the clock starts: kernels are compiled when they are first called.
WARM_UP = 20


def played(frames: Sequence[Frame], rig: Rig, n: int) -> Frame:
    """The n-th frame of a recording that is played forth and back: on the way back an image begins where it ended."""
    way, k = divmod(n, len(frames) - 1)
    begin, end = (frame.depth.stamp for frame in (frames[0], frames[-1]))
    if way % 2 == 0:
        later = way * (end - begin)
        depth, *colors = (Image(i.stamp + later, i.pixels) for i in (frames[k].depth, *frames[k].colors))
        return Frame(depth, tuple(colors))
    mirror = 2 * end + rig.depth_shutter.readout_s + (way - 1) * (end - begin)
    back = frames[-1 - k]

    def mirrored(image: Image, shutter: Shutter) -> Image:
        return Image(mirror - shutter.readout_s - image.stamp, image.pixels)

    colors = [mirrored(image, rig.color_shutter) for image in reversed(back.colors)]
    return Frame(mirrored(back.depth, rig.depth_shutter), tuple(colors))


def survivors(
    count: int, hz: float, clock: Callable[[], float], sleep: Callable[[float], None]
) -> Iterator[tuple[int, float]]:
    """Numbers of the frames that are not dropped, and when each arrived, s: always the newest, waited for if need be.

    clock, sleep: as of `time`, in s. Between two numbers the caller works, and frames go on arriving.
    """
    begin, last = clock(), -1
    while last < count - 1:
        newest = min(int((clock() - begin) * hz), count - 1)
        if newest <= last:
            newest = last + 1
            sleep(max(begin + newest / hz - clock(), 0.0))
        last = newest
        yield newest, begin + newest / hz


def live(
    tracker: AnyTracker, camera: Callable[[int], Frame], count: int, hz: float,
    clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep,
) -> tuple[list[int], np.ndarray]:  # fmt: skip
    """Numbers (n,) of the frames that were tracked, and the seconds (n,) from each one's arrival to its pose."""
    fed, latencies = [], []
    for n, arrived in survivors(count, hz, clock, sleep):
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
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--hz", type=float, default=30.0, help="frames a second that the clock says have arrived")
    parser.add_argument(
        "--budget-ms", type=float, help="of a frame, as of rstrack track; poses depend on the clock then"
    )
    parser.add_argument("--check", action="store_true", help="feed the survivors again without a clock: the same bits?")
    given = parser.parse_args(words)

    dataset, count = open_dataset(given.recording, given.camera), round(given.seconds * given.hz)
    frames, rig = list(dataset.frames(0, max(count, 2))), dataset.rig
    interval_s = dataset.interval_s(range(len(frames)))

    def new() -> AnyTracker:
        return make_tracker(rig, Options(method=given.method, budget_ms=given.budget_ms), interval_s=interval_s)

    def camera(n: int) -> Frame:
        return played(frames, rig, n)

    warm = new()
    for n in range(min(WARM_UP, count)):
        warm.feed(camera(n))
    tracker = new()
    fed, seconds = live(tracker, camera, count, given.hz, clock, sleep)
    lost, cut = (sum(getattr(report, name) for report in tracker.reports) for name in ("lost", "is_cut"))
    told = f"{len(fed)} fed, {count - len(fed)} dropped, {lost} lost, {cut} cut short"
    print(f"{count} frames in {given.seconds:g} s: {told}")
    median, p95, p99 = 1e3 * np.percentile(seconds, [50, 95, 99])
    worst = int(seconds.argmax())
    print(
        f"latency, ms: median {median:.1f}, 95 % {p95:.1f}, 99 % {p99:.1f}, worst {1e3 * seconds[worst]:.1f} "
        f"(frame {fed[worst]})"
    )
    if given.check:
        again = new()
        for n in fed:
            again.feed(camera(n))
        same = np.array_equal(tracker.trajectory[1], again.trajectory[1])
        print("fed again without a clock: " + ("the same bits" if same else "OTHER POSES"))


if __name__ == "__main__":
    main()
