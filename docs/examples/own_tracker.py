"""A tracker of one's own in the bench: any program that reads a sequence's folder and writes a TUM file.

    rstrack bench --sequence table1 --method rs-pg --method baseline \\
        --peer-command flow="python $PWD/docs/examples/own_tracker.py {sequence} {out}"

This one follows corners from each colour image to the next by optical flow, and solves for the camera's motion from
their depth (PnP). It knows of no rolling shutter, keyframe or map: it stands where your own tracker will.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from rsgen import Camera, read_sequence


def motion(gray: np.ndarray, following: np.ndarray, z: np.ndarray, camera: Camera) -> np.ndarray:
    """T_next_this (4, 4) from two grey images (h, w) uint8 and the depth (h, w) of the first, m, 0 = none."""
    corners = cv2.goodFeaturesToTrack(gray, maxCorners=400, qualityLevel=0.002, minDistance=4)
    T = np.eye(4)
    if corners is None:
        return T
    moved, found, _ = cv2.calcOpticalFlowPyrLK(gray, following, corners, None, winSize=(15, 15))
    u, v = np.rint(corners[:, 0]).astype(int).T
    points = camera.backproject(corners[:, 0], z[v, u])
    kept = (found[:, 0] == 1) & (z[v, u] > 0)
    if kept.sum() < 8:
        return T
    # Distortion undone: pixels of a pinhole camera of the same focal length.
    pinhole = np.diag([camera.fx, camera.fx, 1.0])
    pixels = camera.fx * camera.unproject(moved[kept, 0])[:, :2]
    good, rotation, translation, _ = cv2.solvePnPRansac(points[kept], pixels, pinhole, None, reprojectionError=1.0)
    if good:
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return T


def main(words: list[str]) -> None:
    """Read the folder words[0], write the trajectory words[1]: stamps of depth images, T_world_depth."""
    sequence, out = read_sequence(Path(words[0])), Path(words[1])
    cv2.setRNGSeed(0)
    color, T_color_depth = sequence.streams["color"].camera, sequence.T_color_depth
    grid = sequence.depth_image_camera.pixel_grid()
    T_color_image = T_color_depth @ np.linalg.inv(sequence.T_image_depth)

    def frame(k: int) -> tuple[np.ndarray, np.ndarray]:
        """Grey image, and depth (h, w) in the colour camera: its z where a pixel of depth falls, 0 elsewhere."""
        p = sequence.depth_image_camera.backproject(grid, sequence.depth(k)).reshape(-1, 3)
        p = p[p[:, 2] > 0] @ T_color_image[:3, :3].T + T_color_image[:3, 3]
        uv, seen = color.project(p)
        seen &= color.contains(uv)
        u, v = np.rint(uv[seen]).astype(int).T
        z = np.zeros((color.height, color.width))
        z[v, u] = p[seen, 2]
        return cv2.cvtColor(sequence.color(k), cv2.COLOR_RGB2GRAY), z

    T_world_color, lines = np.linalg.inv(T_color_depth), []
    stamps = sequence.streams["depth"].stamps
    gray, z = frame(0)
    for k, stamp in enumerate(stamps):
        if k:
            following, its_z = frame(k)
            T_world_color = T_world_color @ np.linalg.inv(motion(gray, following, z, color))
            gray, z = following, its_z
        T = T_world_color @ T_color_depth
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        lines.append(" ".join(f"{x:.9f}" for x in (stamp, *T[:3, 3], *q)))
    out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
