"""truth/target_corners.txt: where the corners of a calibration target's tags are in the world."""

from __future__ import annotations

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.aprilgrid import AprilGrid

TARGET_CORNERS = "truth/target_corners.txt"


def target_corners_text(grid: AprilGrid, T_world_target: FloatArray) -> str:
    """Lines 'tag corner point x y z': corner 0..3 and point are numbered as Kalibr does, see `AprilGrid`; world, m."""
    p_world = se3.transform(T_world_target, grid.corners()) + 0.0  # no negative zeros
    lines = [
        "# corners of the target's tags in the world, m; point: number in Kalibr's grid",
        "# corner: 0 lower left, 1 lower right, 2 upper right, 3 upper left",
        "# tag corner point x y z",
    ]
    for tag, (points, corners) in enumerate(zip(grid.point_index().tolist(), p_world.tolist(), strict=True)):
        for k, (point, xyz) in enumerate(zip(points, corners, strict=True)):
            lines.append(f"{tag} {k} {point} " + " ".join(f"{value:.12f}" for value in xyz))
    return "\n".join([*lines, ""])
