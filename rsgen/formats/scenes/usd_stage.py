"""Read a USD stage: meshes and solids, instanced or not, with their materials, and lights.

References and payloads are followed as files, on this machine only; variants are those that the file selects.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.formats.meshes.parts import Part, placed
from rsgen.formats.scenes import usd_light
from rsgen.formats.scenes.import_scene import MOST_TRIANGLES, Content, Lamp, Notes, check_installed
from rsgen.formats.scenes.usd_material import UNBOUND, Materials
from rsgen.formats.scenes.usd_mesh import SOLIDS, Primvar, mesh_triangles, parts, smooth_normals, solid
from rsgen.inputs import check_input
from rsgen.scene.placement import SceneOptions, world_from_file

_HIDDEN = ("proxy", "guide")
_DEEPEST = 200  # prims within prims: beyond, instancers hold themselves
_TEXT, _MOST_NESTED = b"#usda", 1000  # brackets within brackets: many more overflow the stack of the parser


def read_content(path: Path, scale: float | None, up: str | None) -> Content:
    """All of the stage at `path`. scale: metres per unit, up: axis of the file; None: what it states.

    Raises UserError for a file that is no USD, is damaged or holds no surface.
    """
    check_installed("pxr", "USD files need the package usd-core", "usd")
    from pxr import Tf, Usd, UsdGeom, UsdUtils

    if not _is_mapped(path):
        check_input(path)
    _check_nesting(path)
    notes = Notes()
    messages = UsdUtils.CoalescingDiagnosticDelegate()  # else they would be printed
    try:
        stage = Usd.Stage.Open(str(path))
        if stage is None:
            raise UserError(f"scene {path}: is no USD file: export it again")
        own_scale, own_up = UsdGeom.GetStageMetersPerUnit(stage), str(UsdGeom.GetStageUpAxis(stage)).lower()
        T_world_stage = world_from_file(SceneOptions(scale or float(own_scale), up or own_up))  # type: ignore[arg-type]
        time = Usd.TimeCode.EarliestTime()
        if stage.HasAuthoredTimeCodeRange():
            time = Usd.TimeCode(stage.GetStartTimeCode())
        _bake_skins(stage, time)
        walk = _Walk(path, time, T_world_stage, own_up == "z", notes)
        walk.children(stage.GetPseudoRoot(), np.eye(4), 0)
        for error in stage.GetCompositionErrors():
            missing = str(error).rpartition("Could not open asset @")[2].partition("@")
            text = Path(missing[0]).name if missing[1] else " ".join(str(error).split())[:150]
            kind = " (usd-core reads no MaterialX)" if text.endswith(".mtlx") else ""
            notes.add(f"part of the scene missing{kind}", text)
        if not walk.parts:
            found = f" ({notes.lines()[0]})" if notes.lines() else ""
            raise UserError(f"scene {path}: holds no surface{found}: export it with meshes")
    except Tf.ErrorException as error:
        raise UserError(
            f"scene {path}: cannot be read ({_reason(error).replace(str(path), path.name)}): export it again"
        ) from None
    finally:
        messages.TakeUncoalescedDiagnostics()
        del messages
    return Content(walk.parts, walk.lamps, notes.lines())


class _Walk:
    """Gathers parts and lamps of a stage."""

    def __init__(self, path: Path, time: Any, T_world_stage: FloatArray, z_up: bool, notes: Notes) -> None:
        self.parts: list[Part] = []
        self.lamps: list[Lamp] = []
        self._path, self._time, self._T_world_stage, self._z_up, self._notes = path, time, T_world_stage, z_up, notes
        self._materials = Materials(time, notes)
        self._made: dict[tuple[str, str], list[Part]] = {}
        self._triangles = 0

    def children(self, prim: Any, T_stage_prim: FloatArray, depth: int) -> None:
        """What is below a prim."""
        from pxr import Usd

        wanted = Usd.PrimIsActive & Usd.PrimIsDefined & Usd.PrimIsLoaded
        if not prim.IsAbstract():  # prototypes of an instancer may be, with all below them
            wanted = Usd.PrimDefaultPredicate
        for child in prim.GetFilteredChildren(Usd.TraverseInstanceProxies(wanted)):
            self.visit(child, T_stage_prim, depth)

    def visit(self, prim: Any, T_stage_parent: FloatArray, depth: int) -> None:
        """A prim and all below it. depth: of prims and instancers that it lies in."""
        from pxr import UsdGeom

        kind, name = str(prim.GetTypeName()), str(prim.GetPath())
        if depth > _DEEPEST:
            raise UserError(f"scene {self._path}: '{name}' lies too deep: an instancer may hold itself")
        T_stage_prim = T_stage_parent
        if prim.IsA(UsdGeom.Imageable):
            if UsdGeom.Imageable(prim).GetVisibilityAttr().Get(self._time) == UsdGeom.Tokens.invisible:
                self._notes.add("invisible, left out", name)
                return
            if str(UsdGeom.Imageable(prim).GetPurposeAttr().Get(self._time)) in _HIDDEN:
                self._notes.add("for display in editors only, left out", name)
                return
        if prim.IsA(UsdGeom.Xformable):
            own = UsdGeom.Xformable(prim)
            T_parent_prim = np.array(own.GetLocalTransformation(self._time), float).T
            T_stage_prim = T_parent_prim if own.GetResetXformStack() else T_stage_prim @ T_parent_prim
            if own.TransformMightBeTimeVarying():
                self._notes.add(f"moves: taken as it is at time {self._time.GetValue():g}", name)
        if kind == "PointInstancer":
            self._instances(prim, name, T_stage_prim, depth + 1)
            return
        if kind == "Mesh" or kind in SOLIDS:
            self._mesh(prim, kind, name, T_stage_prim)
        elif kind in usd_light.LIGHTS:
            lamp = usd_light.lamp(
                prim, self._T_world_stage @ T_stage_prim, T_stage_prim, self._z_up, self._time, self._notes
            )
            self.lamps += [] if lamp is None else [lamp]
        elif kind == "Camera":
            self._notes.add("camera left out", name)
        elif kind not in _SILENT and (prim.IsA(UsdGeom.Gprim) or kind.endswith("Light") or kind == "Volume"):
            self._notes.add(f"{kind} left out", name)
        elif kind == "SkelRoot" and prim.IsInstanceProxy():
            self._notes.add("skinned meshes of an instance in the pose that they were bound in", name)
        self.children(prim, T_stage_prim, depth + 1)

    def _instances(self, prim: Any, name: str, T_stage_prim: FloatArray, depth: int) -> None:
        from pxr import UsdGeom

        instancer, time = UsdGeom.PointInstancer(prim), self._time
        which = instancer.GetProtoIndicesAttr().Get(time)
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        if not which or not targets or max(which) >= len(targets) or min(which) < 0:
            self._notes.add("instancer without instances or prototypes, left out", name)
            return
        transforms = np.array(
            instancer.ComputeInstanceTransformsAtTime(
                time, time, UsdGeom.PointInstancer.ExcludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
            ), float,
        ).reshape(-1, 4, 4).transpose(0, 2, 1)  # fmt: skip
        mask = list(instancer.ComputeMaskAtTime(time)) or [True] * len(which)
        if len(transforms) != len(which):
            self._notes.add("instancer whose arrays differ in length, left out", name)
            return
        for k, T_instancer_instance, there in zip(which, transforms, mask, strict=True):
            prototype = prim.GetStage().GetPrimAtPath(targets[k])
            if there and prototype:
                self.visit(prototype, T_stage_prim @ T_instancer_instance, depth + 1)

    def _mesh(self, prim: Any, kind: str, name: str, T_stage_prim: FloatArray) -> None:
        from pxr import UsdShade

        api = UsdShade.MaterialBindingAPI(prim)
        material = api.ComputeBoundMaterial(UsdShade.Tokens.preview)[0]
        source = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
        key = str(source.GetPath()), str(material.GetPath()) if material else ""
        if key not in self._made:
            self._made[key] = list(self._parts(prim, kind, name, material))
        for part in self._made[key]:
            self._triangles += len(part.faces)
            if self._triangles > MOST_TRIANGLES:
                raise UserError(f"scene {self._path}: more than {MOST_TRIANGLES} triangles: export a part of it")
            self.parts.append(placed(self._path, name, part, self._T_world_stage @ T_stage_prim))

    def _parts(self, prim: Any, kind: str, name: str, material: Any) -> Iterator[Part]:
        from pxr import UsdGeom, UsdShade

        time, notes = self._time, self._notes
        if kind == "Mesh":
            mesh = UsdGeom.Mesh(prim)
            surface = mesh_triangles(mesh, time, notes, name)
            if surface is None:
                return
            if mesh.GetPointsAttr().ValueMightBeTimeVarying():
                notes.add(f"changes its shape: taken as it is at time {time.GetValue():g}", name)
            normals = _normals(prim, mesh, time, surface)
            if normals is None and mesh.GetSubdivisionSchemeAttr().Get(time) != UsdGeom.Tokens.none:
                notes.add("subdivision surface rendered as its control mesh, smoothly shaded", name)
                normals = smooth_normals(surface)
        else:
            surface, normals = solid(prim, UsdGeom, time)
        find = _primvars(prim, time)
        rest = np.ones(len(surface.corners), bool)
        for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
            own = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial(UsdShade.Tokens.preview)[0]
            chosen = np.isin(surface.face, np.array(subset.GetIndicesAttr().Get(time) or [], np.int64)) & rest
            rest &= ~chosen
            part = parts(surface, chosen, self._materials.bound(own or material), normals, find, notes, name)
            if part is not None:
                yield part
        bound = self._materials.bound(material)
        if bound is UNBOUND and find(UNBOUND.colors or "") is None:
            notes.add("neither material nor colour, rendered grey", name)
        part = parts(surface, rest, bound, normals, find, notes, name)
        if part is not None:
            yield part


_SILENT = ("Mesh", *SOLIDS, *usd_light.LIGHTS)


def _bake_skins(stage: Any, time: Any) -> None:
    """Put skinned meshes into their pose, in memory only."""
    from pxr import Gf, UsdSkel

    stage.SetEditTarget(stage.GetSessionLayer())
    at = time.GetValue()
    for root in [UsdSkel.Root(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Root)]:
        UsdSkel.BakeSkinning(root, Gf.Interval(at, at))


def _primvars(prim: Any, time: Any) -> Primvar:
    from pxr import UsdGeom

    api = UsdGeom.PrimvarsAPI(prim)

    def find(name: str) -> tuple[FloatArray, str] | None:
        primvar = api.FindPrimvarWithInheritance(name)
        values = primvar.ComputeFlattened(time) if primvar and primvar.HasValue() else None
        if values is None:
            return None
        array = np.array(values, float)
        interpolation = str(primvar.GetInterpolation())
        return (array[None] if array.ndim == 1 and interpolation == "constant" else array), interpolation

    return find


def _normals(prim: Any, mesh: Any, time: Any, surface: Any) -> FloatArray | None:
    """Authored unit normals (m, 3, 3) at the corners; None if there are none that can be used."""
    found = _primvars(prim, time)("normals")
    if found is None:
        values = mesh.GetNormalsAttr().Get(time)
        if not values:
            return None
        found = np.array(values, float), str(mesh.GetNormalsInterpolation())
    at = surface.at_corners(*found) if found[0].ndim == 2 and found[0].shape[1] == 3 else None
    length = None if at is None else np.linalg.norm(at, axis=-1, keepdims=True)
    if at is None or length is None or not (np.isfinite(length).all() and length.all()):
        return None
    return np.asarray(at / length)


def _is_mapped(path: Path) -> bool:
    """Whether USD does not take the whole file into memory: it is binary or a package."""
    with path.open("rb") as file:
        return path.suffix.lower() == ".usdz" or file.read(8) == b"PXR-USDC"


def _check_nesting(path: Path) -> None:
    """Raises UserError for text that nests so deep that USD's parser would overflow the stack and end the process."""
    with path.open("rb") as file:
        if file.read(len(_TEXT)) != _TEXT:
            return
        letters = np.frombuffer(file.read(), np.uint8)
    steps = (letters == ord("{")).astype(np.int8) - (letters == ord("}")).astype(np.int8)
    steps += (letters == ord("[")).astype(np.int8) - (letters == ord("]")).astype(np.int8)
    if np.cumsum(steps, dtype=np.int32).max(initial=0) > _MOST_NESTED:
        raise UserError(f"scene {path}: nests more than {_MOST_NESTED} deep: it is damaged")


def _reason(error: Exception) -> str:
    """The first of USD's errors, which names the line."""
    try:
        first = " ".join(str(error.args[0] if error.args else error).split())
    except UnicodeDecodeError:  # it quotes a line of bytes that are no text
        return "it is no text"
    return first.rpartition(" : ")[2].strip("' ")[:200] or "no reason given"
