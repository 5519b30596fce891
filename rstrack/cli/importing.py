"""The command `rstrack import`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from rsgen.console.command_line import Quiet


def import_(
    file: Annotated[
        Path,
        "ROS 1 or 2 bag, MCAP, RealSense .bag or .db3, ScanNet .sens, Record3D .r3d, Stray Scanner's or EuRoC's folder",
    ],
    out: Annotated[Path, "folder to write, which 'rstrack track' reads"],
    *,
    color: Annotated[str | None, "topic of the colour images (default: found by types and names)", "TOPIC"] = None,
    depth: Annotated[
        str | None, "topic of the depth images (default: found; the sensor's own before registered)", "TOPIC"
    ] = None,
    color_info: Annotated[str | None, "topic of colour's camera_info (default: the one beside it)", "TOPIC"] = None,
    depth_info: Annotated[str | None, "topic of depth's camera_info (default: the one beside it)", "TOPIC"] = None,
    device: Annotated[
        str | None,
        "camera whose published readouts to write where the recording has none, for example realsense-d435; any other "
        "word lists them",
        "NAME",
    ] = None,
    confidence: Annotated[Literal["0", "1", "2"], "least confidence of ARKit's depth that is kept", "0|1|2"] = "1",
    force: Annotated[bool, "replace a folder that was imported before"] = False,
    quiet: Quiet = False,
) -> int:
    """Turn a recording of another format into a folder that can be tracked: images, stamps, cameras, truth, IMU."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.calibration.unknowns.devices import device_named
    from rstrack.formats.bags.topics import Named
    from rstrack.formats.folder import check_place, write_folder
    from rstrack.formats.formats import open_recording

    known = None if device is None else device_named(device)
    check_place(out, force)
    recording = open_recording(file, Named(color, depth, color_info, depth_info), int(confidence))
    readout_s = (None, None) if known is None else (known.color.readout_s, known.depth.readout_s)
    with ProgressDisplay(quiet) as progress:
        written = write_folder(recording, out, file=file.name, readout_s=readout_s, force=force, progress=progress)
    print(written.text())
    if written.unknown:
        named = f" --device {device}" if device else ""
        print(
            f"nothing tells the readout of {' and '.join(written.unknown)}: "
            f"rstrack calibrate {out} --out {out / 'camera.yaml'}{named}"
        )
    print(f"{out}: ready (rstrack track {out} --out RUN)")
    return 0
