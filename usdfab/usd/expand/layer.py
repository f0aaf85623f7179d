"""The layer that an expansion writes: over the user's stage, of which it hides what fibers replace."""

from __future__ import annotations

import os
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom

from usdfab.usd.stage import GENERATOR, open_stage


def new_layer(source: Path, path: Path) -> Usd.Stage:
    """A stage over ``source``, sublayered by a relative path, with the same stage metadata."""
    layer = Sdf.Layer.CreateNew(str(path))
    layer.subLayerPaths.append(relative_path(source, path.parent))
    stage = Usd.Stage.Open(layer)
    base = open_stage(source)
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.GetStageMetersPerUnit(base))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.GetStageUpAxis(base))
    if base.HasDefaultPrim():
        layer.defaultPrim = base.GetRootLayer().defaultPrim
    if base.HasAuthoredTimeCodeRange():
        stage.SetStartTimeCode(base.GetStartTimeCode())
        stage.SetEndTimeCode(base.GetEndTimeCode())
    layer.timeCodesPerSecond = base.GetTimeCodesPerSecond()
    layer.customLayerData = {"usdfab": {"generator": GENERATOR}}
    return stage


def relative_path(file: str | Path, folder: Path) -> str:
    """``file`` as seen from ``folder``, with forward slashes, so that both can be moved together."""
    found = Path(os.path.relpath(Path(file).absolute(), folder.absolute())).as_posix()
    return found if found.startswith(".") else f"./{found}"


def editable(stage: Usd.Stage, path: str) -> Usd.Prim:
    """The prim at ``path``; native instances on the way are made prims of their own, in this layer."""
    prim = stage.GetPrimAtPath(path)
    while prim.IsInstanceProxy():
        instance = prim
        while not instance.IsInstance() or instance.IsInstanceProxy():
            instance = instance.GetParent()
        instance.SetInstanceable(False)
        prim = stage.GetPrimAtPath(path)
    return prim


def replace_mesh(prim: Usd.Prim, purpose: str) -> None:
    """Take a mesh out of the picture: invisible, or where fibers are for final renders only, the proxy shown else."""
    if purpose == UsdGeom.Tokens.default_:
        UsdGeom.Imageable(prim).MakeInvisible()
    else:
        UsdGeom.Imageable(prim).CreatePurposeAttr(UsdGeom.Tokens.proxy)
