"""Mitsuba started once for the rendering tests, a small glowing room without noise, and what its rays should do.

Import this before anything that imports Mitsuba or Dr.Jit: it selects the backend.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import synthetic
import trimesh

from rsgen.array_types import FloatArray
from rsgen.device.arrays import rows_of
from rsgen.device.backend import mitsuba
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter

mi: Any = mitsuba()

import drjit as dr  # noqa: E402

__all__ = ["dr", "mi"]

Motion = Callable[[FloatArray], FloatArray]
SCANS = ("top-bottom", "bottom-top", "left-right", "right-left")
CAMERA = Camera(40, 30, 31.0, 30.0, 18.3, 15.2)
RADTAN = Camera(40, 30, 31.0, 30.0, 18.3, 15.2, "radtan", (-0.21, 0.06, 0.004, -0.003, -0.01))
FISHEYE = Camera(40, 30, 20.0, 20.5, 18.8, 15.2, "fisheye", (0.02, -0.01, 0.004, -0.0007))


def constant_twist(xi: Sequence[float], T_start: FloatArray | None = None) -> Motion:
    """T_world_cam (n, 4, 4) at times (n,) s of a motion with the body twist xi = [m/s; rad/s] from `T_start`."""
    start = np.eye(4) if T_start is None else T_start
    return lambda t: start @ se3.exp(np.multiply.outer(np.asarray(t, float), np.asarray(xi, float)))


def pixel_times(camera: Camera, shutter: Shutter, stamp: float) -> FloatArray:
    """Mid-exposure time (h, w) of every pixel's line, s."""
    return shutter.line_mid_time(stamp, shutter.line_of_pixel(camera.pixel_grid(), camera), camera)


def pixel_rays(camera: Camera, shutter: Shutter, motion: Motion, stamp: float) -> tuple[FloatArray, FloatArray]:
    """World origins and directions (h, w, 3), planar z = ray parameter, of all pixels at their lines' mid-exposure."""
    T = motion(pixel_times(camera, shutter, stamp).ravel()).reshape(camera.height, camera.width, 4, 4)
    return T[..., :3, 3], np.einsum("...ij,...j->...i", T[..., :3, :3], camera.unproject(camera.pixel_grid()))


def glow(p: FloatArray) -> FloatArray:
    """Radiance (n, 3) that surface points (n, 3) of the room send out: smooth, positive, different everywhere."""
    return 0.5 + 0.4 * np.sin(p @ np.array([[5, 2, 1], [1, 6, -2], [-2, 1, 7.0]]))


def room_meshes(M: FloatArray | None = None) -> list[trimesh.Trimesh]:
    """The room of `synthetic` (box seen from inside, ball) moved by M (3, 3), with `glow` as attribute `colors`."""
    box = trimesh.creation.box(bounds=synthetic.BOX)
    for _ in range(4):
        box = box.subdivide()
    box.invert()
    ball = trimesh.creation.icosphere(3, synthetic.BALL_RADIUS)
    ball.apply_translation(synthetic.BALL)
    for mesh in (box, ball):
        mesh.metadata["glow"] = glow(np.asarray(mesh.vertices))
        if M is not None:
            mesh.vertices = mesh.vertices @ M.T
            if np.linalg.det(M) < 0:
                mesh.faces = mesh.faces[:, ::-1]
    return [box, ball]


def write_glowing_ply(path: Path, mesh: trimesh.Trimesh) -> None:
    """ASCII PLY of a mesh with its glow as Mitsuba's attribute `vertex_color`."""
    rows = np.concatenate([mesh.vertices, mesh.metadata["glow"]], axis=1)
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in "xyzrgb"]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    lines = [" ".join(f"{x:.9g}" for x in row) for row in rows]
    lines += [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    path.write_text("\n".join([*header, *lines, ""]))


def room_xml(folder: Path, M: FloatArray | None = None) -> Path:
    """Write the glowing room as `scene.xml` with its meshes into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    shapes = []
    for k, mesh in enumerate(room_meshes(M)):
        write_glowing_ply(folder / f"{k}.ply", mesh)
        shapes.append(f"""
    <shape type="ply">
        <string name="filename" value="{k}.ply"/>
        <boolean name="face_normals" value="true"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.3"/></bsdf>
        <emitter type="area">
            <texture type="mesh_attribute" name="radiance"><string name="name" value="vertex_color"/></texture>
        </emitter>
    </shape>""")
    (folder / "scene.xml").write_text(
        f"""<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="1"/></integrator>{"".join(shapes)}
</scene>
"""
    )
    return folder / "scene.xml"


def emission_integrator() -> Any:
    """Emission at the first hit and nothing else: no noise but that of where and when the samples lie."""
    return mi.load_dict({"type": "path", "max_depth": 1})


class RayProbe(mi.SamplingIntegrator):
    """Integrator that keeps the rays it is given: `origin`, `direction` (n, 3) and `time` (n,) of the last launch."""

    def __init__(self) -> None:
        super().__init__(mi.Properties())
        self.origin = self.direction = self.time = np.zeros(0)

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True):
        self.origin, self.direction = (rows_of(v) for v in (ray.o, ray.d))
        self.time = np.array(ray.time)
        return mi.Color3f(ray.time), mi.Bool(True), []
