"""Pictures of a Mitsuba scene by Blender Cycles with its own rolling shutter: a peer for times, and for pictures.

    with BlenderRenderer(scene, camera, [exposure(spline.pose, shutter, stamp)], spp=64, max_depth=12) as blender:
        seconds, linear = blender.render(0)

Blender comes as PyPI's `bpy` and runs in a process of its own, whose crash is not ours. It gets the scene's triangles,
normals, diffuse colours and textures, area lamps and uniform sky; glossy surfaces lose their gloss.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter

# Poses from the first line's opening to the last line's closing; as many as Cycles' motion steps take.
_POSES = 9
_INSTALL = "install it with: pip install 'bpy==4.2.*' (Python 3.11)"
# What Mitsuba calls the colours of diffuse lobes and of lamps.
_COLOURS = {"diffuse_reflectance", "reflectance", "base_color", "radiance"}
_GREY = 0.5  # in the place of metals and glass, which have no diffuse lobe


@dataclass(frozen=True)
class ExposurePath:
    """One picture's camera path: T_world_cam (n, 4, 4), evenly spaced in time from the opening to the closing.

    line_share: each line's exposure as a share of that time; None for a still, whose path has one pose.
    """

    T_world_cam: FloatArray
    line_share: float | None


def exposure(T_world_cam: Any, shutter: Shutter, stamp: float) -> ExposurePath:
    """The exposure of a frame stamped `stamp` (s): T_world_cam maps times (n,) s to (n, 4, 4), e.g. `Spline.pose`.

    Raises UserError for another scan than top-bottom, which is the only one that Blender knows.
    """
    span = shutter.readout_s + shutter.exposure_s
    if span == 0:
        return ExposurePath(np.asarray(T_world_cam(np.array([stamp])), float), None)
    if shutter.scan != "top-bottom":
        raise UserError(f"scan '{shutter.scan}': Blender's rolling shutter runs from top to bottom only")
    times = stamp - shutter.exposure_s + span * np.linspace(0, 1, _POSES)
    return ExposurePath(np.asarray(T_world_cam(times), float), shutter.exposure_s / span)


def check_installed() -> None:
    """Raises UserError if there is no Blender for this Python."""
    if find_spec("bpy") is None:
        raise UserError(f"Blender's Python module bpy is not installed: {_INSTALL}")


class BlenderRenderer(AbstractContextManager["BlenderRenderer"]):
    """Blender in a child process that keeps the scene between pictures; close it, or use it as a context."""

    def __init__(self, scene: Any, camera: Camera, exposures: Sequence[ExposurePath], spp: int, max_depth: int) -> None:
        """Start Blender and give it the scene. max_depth: of paths, as Mitsuba's `path` counts it.

        Raises UserError if Blender is missing or fails, or if the camera or scene is beyond it.
        """
        check_installed()
        if any(camera.distortion):
            raise UserError(f"camera model '{camera.model}': Blender renders without distortion only")
        self._camera = camera
        self._folder = tempfile.TemporaryDirectory(prefix="rsgen-blender-")
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed with the process)
        root = Path(self._folder.name)
        self._process: subprocess.Popen[str] | None = None
        try:
            arrays, names, sky = export_scene(scene)
            arrays |= {f"poses{k}": e.T_world_cam for k, e in enumerate(exposures)}
            # A path of depth d has d - 1 surfaces, the first seen and the last a lamp.
            bounces = max(0, max_depth - 2)
            job = {
                "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
                "cx": camera.cx, "cy": camera.cy, "spp": spp, "max_bounces": bounces, "sky": sky, "meshes": names,
                "line_shares": [e.line_share for e in exposures],
            }  # fmt: skip
            np.savez(root / "job.npz", allow_pickle=False, **arrays)
            (root / "job.json").write_text(json.dumps(job))
            self._process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.rendering.blender_worker", str(root)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, text=True,
            )  # fmt: skip
            self.version: str = self._answer()["version"]
        except BaseException:
            self.close()
            raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process and delete what was written for it."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        self._log.close()
        self._folder.cleanup()

    def time(self, index: int) -> float:
        """Seconds that Blender takes to render exposure `index`. Raises UserError if it fails."""
        return float(self._ask(index, None)["seconds"])

    def render(self, index: int) -> Float32Array:
        """Linear RGB (h, w, 3) of exposure `index`. Raises UserError if Blender fails."""
        import OpenEXR

        path = Path(self._folder.name) / "picture.exr"
        self._ask(index, path)
        with OpenEXR.File(str(path)) as file:
            channels = file.channels()
            pixels = next((channels[name].pixels for name in ("RGB", "RGBA") if name in channels), None)
            if pixels is None:
                pixels = np.stack([channels[name].pixels for name in "RGB"], axis=-1)
            return np.array(pixels[..., :3], np.float32)

    def _ask(self, index: int, picture: Path | None) -> dict[str, Any]:
        assert self._process is not None and self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"exposure": index, "picture": picture and str(picture)}) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # it is dead, as its answer will tell
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process is not None and self._process.stdout is not None
        line = self._process.stdout.readline()
        if line:
            answer: dict[str, Any] = json.loads(line)
            return answer
        self._process.wait()
        self._log.seek(0)
        said = [text for text in self._log.read().splitlines() if text.strip()]
        raise UserError(
            f"Blender ended with status {self._process.returncode} ({said[-1].strip() if said else 'no message'}): "
            "leave its modes out, or try another version of bpy"
        )


def export_scene(scene: Any) -> tuple[dict[str, NDArray], list[str], list[float]]:
    """What Blender needs of a Mitsuba scene: arrays NAME_k of mesh k, the meshes' names, and the sky's radiance.

    vertices (n, 3) in the world frame, m; faces (m, 3); normals (n, 3) and uv (n, 2) where the mesh has them; colour
    and radiance (lamps), linear, (3,) or a picture (h, w, 3). Raises UserError for lights other than area lamps and a
    uniform sky, and for colours that are neither plain nor pictures.
    """
    import mitsuba as mi

    from rsgen.render.meshes import mesh_arrays

    arrays: dict[str, NDArray] = {}
    names: list[str] = []
    for shape in scene.shapes():
        if not shape.is_mesh():
            continue
        k = len(names)
        names.append(shape.id() or f"mesh {k}")
        arrays[f"vertices_{k}"], arrays[f"faces_{k}"] = mesh_arrays(shape)
        if shape.has_vertex_normals():
            arrays[f"normals_{k}"] = np.asarray(shape.vertex_normals_buffer(), np.float32).reshape(-1, 3)
        bsdf, to_uv = shape.bsdf(), np.eye(3)
        if bsdf.flags() & int(mi.BSDFFlags.DiffuseReflection):
            arrays[f"colour_{k}"], to_uv = _colours(mi, bsdf, bsdf.eval_diffuse_reflectance, names[k])
        else:
            arrays[f"colour_{k}"] = np.full(3, _GREY, np.float32)
        if shape.is_emitter():
            lamp = shape.emitter()
            arrays[f"radiance_{k}"], lamp_to_uv = _colours(mi, lamp, lamp.eval, names[k])
            to_uv = lamp_to_uv if arrays[f"radiance_{k}"].ndim == 3 else to_uv
        if shape.has_vertex_texcoords():
            uv = np.asarray(shape.vertex_texcoords_buffer(), np.float32).reshape(-1, 2)
            arrays[f"uv_{k}"] = (uv @ to_uv[:2, :2].T + to_uv[:2, 2]).astype(np.float32)
    return arrays, names, _sky(mi, scene)


def _colours(mi: Any, owner: Any, evaluate: Any, shape: str) -> tuple[NDArray, NDArray]:
    """Linear colour (3,) or texels (h, w, 3) of a BSDF or lamp, and the transform of uv (3, 3) that goes with them."""
    parameters = mi.traverse(owner)
    keys = [key for key in parameters.keys() if set(key.split(".")) & _COLOURS]  # noqa: SIM118 (no dict)
    picture = next((key for key in keys if key.endswith(".data")), None)
    if picture is None and not any(key.endswith(".value") for key in keys):
        raise UserError(f"shape '{shape}': its colour is neither plain nor a picture, as Blender needs it")
    h, w, to_uv = 1, 1, np.eye(3)
    if picture is not None:
        h, w = parameters[picture].shape[:2]
        to_uv = np.asarray(parameters[picture.removesuffix("data") + "to_uv"].matrix, float).reshape(3, 3)
    # Mitsuba keeps some pictures in sRGB, some linear: what it makes of their texels' centres is always linear.
    v, u = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(w) + 0.5) / w, indexing="ij")
    uv = np.linalg.solve(to_uv, np.stack([u.ravel(), v.ravel(), np.ones(h * w)]))
    si = _dummy_hits(mi, uv[:2])
    colours = np.asarray(mi.unpolarized_spectrum(evaluate(si)), np.float32).reshape(3, -1).T
    return (colours[0], to_uv) if picture is None else (colours.reshape(h, w, 3).astype(np.float16), to_uv)


def _dummy_hits(mi: Any, uv: NDArray) -> Any:
    """Surface interactions at texture coordinates uv (2, n), seen from the front."""
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, uv.shape[1])
    si.uv = mi.Point2f(uv.astype(np.float32))
    si.wi = mi.Vector3f(0, 0, 1)
    si.t = 1.0
    return si


def _sky(mi: Any, scene: Any) -> list[float]:
    total = np.zeros(3)
    for emitter in scene.emitters():
        if emitter.get_shape() is not None:
            continue
        kind = str(emitter).partition("[")[0]
        if kind != "ConstantBackgroundEmitter":
            raise UserError(f"light '{kind}': only area lamps and a uniform sky can be given to Blender")
        total += _colours(mi, emitter, emitter.eval, "sky")[0]
    return [float(x) for x in total]
