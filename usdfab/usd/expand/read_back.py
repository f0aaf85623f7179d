"""Fibers of an expanded file, as they stand in the world: to look at and to measure what was written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from usdfab.usd.stage import open_stage

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WorldCurves:
    """Control points of cubic B-splines: ``points`` (N, 3) metres, ``counts`` (curves,), ``color`` (curves, 3)."""

    points: Floats
    counts: NDArray[np.int64]
    color: Floats
    radius: float


def world_curves(source: str | Path | Usd.Stage, center: Floats, reach: float) -> list[WorldCurves]:
    """All curves, instanced or not, that have a control point within ``reach`` metres of ``center`` (3,), metres."""
    stage = open_stage(source)
    meters = UsdGeom.GetStageMetersPerUnit(stage)
    cache = UsdGeom.XformCache()
    found: list[WorldCurves] = []
    prims = iter(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
            found += _instanced(UsdGeom.PointInstancer(prim), cache, meters, center, reach)
        elif prim.IsA(UsdGeom.BasisCurves):
            matrix = np.array(cache.GetLocalToWorldTransform(prim))
            found += _near(UsdGeom.BasisCurves(prim), matrix, meters, center, reach)
    return found


def _instanced(
    instancer: UsdGeom.PointInstancer, cache: UsdGeom.XformCache, meters: float, center: Floats, reach: float
) -> list[WorldCurves]:
    stage, time = instancer.GetPrim().GetStage(), Usd.TimeCode.Default()
    to_world = np.array(cache.GetLocalToWorldTransform(instancer.GetPrim()))
    matrices = np.array(instancer.ComputeInstanceTransformsAtTime(time, time)) @ to_world
    targets = instancer.GetPrototypesRel().GetForwardedTargets()
    proto = np.asarray(instancer.GetProtoIndicesAttr().Get())
    curves = {
        number: [p for p in Usd.PrimRange.AllPrims(stage.GetPrimAtPath(target)) if p.IsA(UsdGeom.BasisCurves)]
        for number, target in enumerate(targets)
    }
    sizes = np.array([_size(curves[number]) for number in range(len(targets))]) * meters
    places = matrices[:, 3, :3] * meters
    stretch = np.linalg.norm(matrices[:, :3, :3], axis=(1, 2))
    near = np.linalg.norm(places - center, axis=1) <= reach + stretch * sizes[proto]
    out: list[WorldCurves] = []
    for k in np.flatnonzero(near):
        for prim in curves[int(proto[k])]:
            out += _near(UsdGeom.BasisCurves(prim), matrices[k], meters, center, reach)
    return out


def _size(prims: list[Usd.Prim]) -> float:
    """Distance of the farthest corner of the curves' extents from the origin."""
    extents = [np.abs(np.array(UsdGeom.BasisCurves(p).GetExtentAttr().Get())) for p in prims]
    return max((float(np.linalg.norm(e.max(axis=0))) for e in extents), default=0.0)


def _near(
    curves: UsdGeom.BasisCurves, matrix: Floats, meters: float, center: Floats, reach: float
) -> list[WorldCurves]:
    points = np.asarray(curves.GetPointsAttr().Get(), dtype=float)
    points = (points @ matrix[:3, :3] + matrix[3, :3]) * meters
    counts = np.asarray(curves.GetCurveVertexCountsAttr().Get(), dtype=np.int64)
    starts = np.cumsum(counts) - counts
    close = np.linalg.norm(points - center, axis=1) <= reach
    chosen = np.maximum.reduceat(close, starts)
    if not chosen.any():
        return []
    color = np.asarray(curves.GetDisplayColorAttr().Get(), dtype=float)
    if len(color) == len(points) and len(points) != len(counts):
        color = color[starts]
    color = np.broadcast_to(color, (len(counts), 3))
    radius = 0.5 * float(curves.GetWidthsAttr().Get()[0]) * meters
    return [WorldCurves(points[np.repeat(chosen, counts)], counts[chosen], color[chosen], radius)]
