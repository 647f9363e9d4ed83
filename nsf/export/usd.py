"""`--usd`: points with time samples for usdview, Omniverse, Blender or Houdini."""

from pathlib import Path

import numpy as np

from nsf.bodies.colors import STRESS_COLORS, ColorScale
from nsf.export.playback import Block, Playback
from nsf.extras import optional
from nsf.storage import writing

NEEDS = ("pxr.Usd", "pxr.UsdGeom", "pxr.Sdf", "pxr.Vt")


def write(playback: Playback, folder: Path) -> Path:
    """Write a stage with a `Points` prim for each block of points, in metres, z up.

    Time code k is frame k at `fps` frames a second. The attribute `nsf:time` of the root prim holds the time
    of each frame in seconds. Primvars with one value a point: displayColor by the quantity of the playback;
    displacement [m]; vonMises and pressure [Pa]; kirchhoffStress [Pa], six values as xx xy xz yy yz zz.

    The file is saved after each block, which frees the block's memory.

    Raises:
        MissingExtraError: usd-core is not installed.
    """
    Usd, UsdGeom, Sdf, _ = (optional(name, "export") for name in NEEDS)
    path = folder / f"{playback.name}.usdc"
    with writing(path) as partial:
        stage = Usd.Stage.CreateNew(str(partial))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(playback.fps)
        stage.SetFramesPerSecond(playback.fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(playback.t) - 1)
        root = UsdGeom.Xform.Define(stage, "/run")
        stage.SetDefaultPrim(root.GetPrim())
        root.GetPrim().SetDocumentation(playback.title)
        time = root.GetPrim().CreateAttribute("nsf:time", Sdf.ValueTypeNames.Double)
        for k, seconds in enumerate(playback.t):
            time.Set(float(seconds), k)
        for number, block in enumerate(playback.blocks("usd")):
            prim = UsdGeom.Points.Define(stage, f"/run/points_{number:04d}")
            _fill(prim, block, playback)
            stage.Save()
    return path


def _fill(points, block: Block, playback: Playback) -> None:
    _, UsdGeom, Sdf, Vt = (optional(name, "export") for name in NEEDS)
    kinds, vertex = Sdf.ValueTypeNames, UsdGeom.Tokens.vertex
    api = UsdGeom.PrimvarsAPI(points)
    color = points.CreateDisplayColorPrimvar(vertex)
    displacement = api.CreatePrimvar("displacement", kinds.Vector3fArray, vertex)
    scalars = {name: api.CreatePrimvar(name, kinds.FloatArray, vertex) for name in ("vonMises", "pressure")}
    stress = api.CreatePrimvar("kirchhoffStress", kinds.FloatArray, vertex, 6)
    points.CreateWidthsAttr([2 * playback.radius])
    points.SetWidthsInterpolation(UsdGeom.Tokens.constant)

    def vectors(values) -> object:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))

    def numbers(values) -> object:
        return Vt.FloatArray.FromNumpy(np.ascontiguousarray(values, np.float32).ravel())

    moved, von_mises, pressure = block.displacement, block.von_mises, block.pressure
    shown = block.magnitude(playback.color)
    scale = ColorScale(playback.tops[playback.color], STRESS_COLORS, 1.0, playback.color)
    for k in range(len(block.x)):
        x = block.x[k].float().numpy()
        points.GetPointsAttr().Set(vectors(x), k)
        points.GetExtentAttr().Set(vectors([x.min(0) - playback.radius, x.max(0) + playback.radius]), k)
        displacement.Set(vectors(moved[k].numpy()), k)
        scalars["vonMises"].Set(numbers(von_mises[k].numpy()), k)
        scalars["pressure"].Set(numbers(pressure[k].numpy()), k)
        stress.Set(numbers(block.tau[k].numpy()), k)
        color.Set(vectors(scale.colors(shown[k].numpy())), k)
