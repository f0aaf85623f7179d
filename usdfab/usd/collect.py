"""Which prims of a stage are to be drawn, and where: visibility, purpose, native instances, point instancers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from usdfab.errors import UsdfabError
from usdfab.usd.frames import Shutter
from usdfab.usd.problems import Problems
from usdfab.usd.read_lights import is_light, matrix
from usdfab.usd.scene import Array
from usdfab.usd.stage import site

PURPOSES = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
MAX_COPIES = 20_000_000
"""More copies of one prototype than this are refused: 2.5 GB of transforms."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A prim and where it stands.

    ``to_world`` (K, 4, 4), column vectors, stage units: one for each copy as the shutter opens; ``to_world_close`` the
    same as it closes, or None where the shutter is not open for any time. ``copied``: below a point instancer.
    """

    prim: Usd.Prim
    to_world: Array
    to_world_close: Array | None
    copied: bool

    @property
    def source(self) -> Sdf.Path:
        """Path of what the prim is a copy of: one for all native instances of a prototype."""
        return canonical(self.prim)


def canonical(prim: Usd.Prim) -> Sdf.Path:
    """A prim's path, or, in a native instance, the path of the prim in its prototype."""
    return (prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath()


def drawn_prims(
    stage: Usd.Stage, time: Usd.TimeCode, purposes: tuple[str, ...] = PURPOSES, root: Usd.Prim | None = None
) -> Iterator[Usd.Prim]:
    """Visible prims of the wanted purposes, native instances included; what is below point instancers is left out.

    ``root``: a prototype of an instancer, which is drawn also where it stands below an ``over``.
    """
    if root is None:
        prims = iter(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    else:
        prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)))
    for prim in prims:
        imageable = UsdGeom.Imageable(prim)
        if imageable and imageable.GetVisibilityAttr().Get(time) == UsdGeom.Tokens.invisible:
            prims.PruneChildren()
            continue
        if prim.IsA(UsdGeom.PointInstancer):
            # Its prototypes may lie below it and are not shapes of their own.
            prims.PruneChildren()
        if imageable and imageable.ComputePurpose() in purposes and prim.HasDefiningSpecifier():
            yield prim


class Collector:
    """Sorts a stage's prims into ``cameras``, ``lights`` and ``meshes``, each with its places in the world."""

    def __init__(
        self,
        stage: Usd.Stage,
        shutter: Shutter,
        problems: Problems,
        purposes: tuple[str, ...] = PURPOSES,
        *,
        instancers: bool = True,
    ) -> None:
        self.stage, self.shutter, self.problems, self.purposes = stage, shutter, problems, purposes
        self.instancers = instancers
        self.open = UsdGeom.XformCache(shutter.open)
        self.close = None if shutter.close is None else UsdGeom.XformCache(shutter.close)
        self.cameras: list[Placed] = []
        self.lights: list[Placed] = []
        self.meshes: list[Placed] = []
        self.unsupported: Counter[str] = Counter()

    def collect(self) -> None:
        """Walk the stage."""
        identity = np.eye(4)[None]
        self._walk(None, identity, None if self.close is None else identity, ())

    def left_out(self) -> list[str]:
        """A warning for each type of shape that was met and not read."""
        return [f"{count} prims of type {kind} are not supported, left out" for kind, count in self.unsupported.items()]

    def _walk(self, root: Usd.Prim | None, base: Array, base_close: Array | None, above: tuple[Sdf.Path, ...]) -> None:
        """Prims below ``root``, a prototype, or of the whole stage; ``base`` (K, 4, 4) are the root's copies."""
        for prim in drawn_prims(self.stage, self.shutter.frame, self.purposes, root):
            mesh, light = prim.IsA(UsdGeom.Mesh), is_light(prim)
            instancer, camera = prim.IsA(UsdGeom.PointInstancer), prim.IsA(UsdGeom.Camera)
            if not (mesh or light or instancer or camera):
                if prim.IsA(UsdGeom.Gprim):
                    self.unsupported[prim.GetTypeName()] += 1
                continue
            if above and (light or camera):
                self.problems.warn(f"{prim.GetPath()}: lights and cameras are not copied by point instancers, left out")
            # Transforms that are not finite are found where the prim is read.
            with np.errstate(invalid="ignore", over="ignore"):
                opened = base @ self._to(prim, root, self.open)
                closed = None
                if base_close is not None and self.close is not None:
                    closed = base_close @ self._to(prim, root, self.close)
            placed = Placed(prim, opened, closed, bool(above))
            if light and not above:
                self.lights.append(placed)
            if camera and not above:
                self.cameras.append(placed)
            if mesh:
                self.meshes.append(placed)
            if instancer and not self.instancers:
                self.unsupported["PointInstancer"] += 1
            elif instancer:
                with self.problems.tolerating(str(prim.GetPath()), "the instancer is left out"):
                    self._instancer(placed, above)

    @staticmethod
    def _to(prim: Usd.Prim, root: Usd.Prim | None, cache: UsdGeom.XformCache) -> Array:
        """(4, 4) from a prim to the world, or to a prototype's root (whose own transform counts among its copies')."""
        if root is None:
            return matrix(cache.GetLocalToWorldTransform(prim))
        return matrix(cache.ComputeRelativeTransform(prim, root)[0])

    # --- point instancers ---

    def _instancer(self, placed: Placed, above: tuple[Sdf.Path, ...]) -> None:
        prim, shutter = placed.prim, self.shutter
        if prim.GetPath() in above:
            raise UsdfabError("the point instancer holds itself", place=site(self.stage, prim))
        instancer = UsdGeom.PointInstancer(prim)
        proto, keep = self._indices(instancer)
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        used = np.unique(proto[keep])
        if len(used) == 0:
            return
        if used[0] < 0 or used[-1] >= len(targets):
            worst = used[0] if used[0] < 0 else used[-1]
            place = site(self.stage, instancer.GetProtoIndicesAttr())
            raise UsdfabError(f"prototype {worst} does not exist, there are {len(targets)}", place=place)
        own = self._copies(instancer, shutter.open, len(proto))
        own_close = None if shutter.close is None else self._copies(instancer, shutter.close, len(proto))
        for number in used:
            target = self.stage.GetPrimAtPath(targets[number])
            if not target:
                problem = f"the prototype {targets[number]} does not exist"
                fault = UsdfabError(problem, place=site(self.stage, prim))
                self.problems.fault(fault, "its copies are left out")
                continue
            chosen = keep & (proto == number)
            if len(placed.to_world) * int(chosen.sum()) > MAX_COPIES:
                problem = f"more than {MAX_COPIES} copies of {target.GetPath()}"
                raise UsdfabError(problem, place=site(self.stage, prim), remedy="nest fewer instancers")
            base = _products(placed.to_world, own[chosen])
            close = None
            if placed.to_world_close is not None and own_close is not None:
                close = _products(placed.to_world_close, own_close[chosen])
            self._walk(target, base, close, (*above, prim.GetPath()))

    def _indices(self, instancer: UsdGeom.PointInstancer) -> tuple[np.ndarray, np.ndarray]:
        """(N,) prototype of each copy, (N,) whether it is drawn."""
        raw = instancer.GetProtoIndicesAttr().Get(self.shutter.frame)
        proto = np.asarray(raw if raw is not None else [], dtype=np.int64)
        mask = np.asarray(instancer.ComputeMaskAtTime(self.shutter.frame), dtype=bool)
        # An empty mask means that all are drawn.
        return proto, mask if len(mask) == len(proto) else np.ones(len(proto), dtype=bool)

    def _copies(self, instancer: UsdGeom.PointInstancer, time: Usd.TimeCode, expected: int) -> Array:
        """(N, 4, 4) transforms of the copies, the prototypes' own included."""
        found = instancer.ComputeInstanceTransformsAtTime(
            time, self.shutter.frame, UsdGeom.PointInstancer.IncludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
        )
        if len(found) != expected:
            raise UsdfabError(
                f"{expected} prototype indices, but {len(found)} positions, orientations and scales that fit",
                place=site(self.stage, instancer),
            )
        return np.asarray(found, dtype=np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)


def _products(outer: Array, inner: Array) -> Array:
    """(K * N, 4, 4): every outer transform times every inner one, the inner ones running fastest."""
    return (outer[:, None] @ inner[None]).reshape(-1, 4, 4)
