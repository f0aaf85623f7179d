"""What a fabric is to be bound to: prims, subsets of faces and collections of a stage, found and checked."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdfab.errors import UsdfabError
from usdfab.usd.collect import drawn_prims
from usdfab.usd.primvars import UV_NAMES
from usdfab.usd.stage import site, stage_name

MAX_LISTED = 8
"""So many candidates are named in an error."""
FAMILY = str(UsdShade.Tokens.materialBind)


@dataclass(frozen=True, eq=False)
class Target:
    """One binding to author.

    ``prim`` carries it; ``collection`` is its name where a collection of that prim (or of ``owner``) is bound.
    ``meshes`` are what is to show the fabric: meshes, or the one subset.
    """

    prim: Usd.Prim
    meshes: tuple[Usd.Prim, ...]
    collection: Sdf.Path | None = None

    @property
    def path(self) -> str:
        return str(self.collection or self.prim.GetPath())

    def holders(self) -> tuple[Usd.Prim, ...]:
        """Prims that carry the orientation: the bound one, or a collection's meshes (their instances, if any)."""
        if self.collection is None:
            return (self.prim,)
        return tuple(dict.fromkeys(instance_root(mesh) or mesh for mesh in self.meshes))


# --- prims -----------------------------------------------------------------------------------------------------------


def prim_target(stage: Usd.Stage, path: str) -> Target:
    """The mesh, subset or ancestor at ``path``.

    Raises
    ------
    UsdfabError
        If there is no such prim, it is inside an instance or a prototype, inactive, abstract or undefined, a subset of
        something else than faces, or there is no mesh below it.
    """
    prim = existing(stage, path)
    if prim.IsA(UsdGeom.Subset):
        return Target(prim, (_checked_subset(UsdGeom.Subset(prim)),))
    meshes = meshes_below(prim)
    if not meshes:
        kind = prim.GetTypeName() or "prim without type"
        problem = f"this {kind} is no mesh and holds none"
        raise UsdfabError(problem, place=site(stage, prim), remedy=candidates_text(stage))
    return Target(prim, meshes)


def existing(stage: Usd.Stage, path: str) -> Usd.Prim:
    """The prim at ``path``, one that overs can reach; errors as ``prim_target``."""
    place = f"{stage_name(stage)}<{path}>"
    if not Sdf.Path.IsValidPathString(path) or not Sdf.Path(path).IsAbsoluteRootOrPrimPath():
        raise UsdfabError("this is not a prim path", place=place, remedy="prim paths look like /World/Cloth")
    prim = stage.GetPrimAtPath(path)
    if not prim or prim.IsPseudoRoot():
        raise UsdfabError("there is no such prim", place=place, remedy=_nearest(stage, path))
    root = instance_root(prim)
    if root is not None:
        remedy = f"bind the instance root {root.GetPath()}, all of its copy then wears the fabric"
        raise UsdfabError("the prim is inside an instance, where nothing can be authored", place=place, remedy=remedy)
    if prim.IsInPrototype():
        raise UsdfabError("the prim is a prototype that USD made", place=place, remedy="bind an instance of it")
    if not prim.IsActive():
        raise UsdfabError("the prim is deactivated", place=place, remedy="activate it first, or choose another")
    if prim.IsAbstract():
        raise UsdfabError("the prim is a class, which is not drawn", place=place, remedy="bind what inherits it")
    if not prim.HasDefiningSpecifier() and not meshes_below(prim):
        raise UsdfabError("the prim is an over of nothing", place=place, remedy="is a reference or payload missing?")
    return prim


def instance_root(prim: Usd.Prim) -> Usd.Prim | None:
    """The instance, outside of any other, that an instance proxy belongs to; None for other prims."""
    if not prim.IsInstanceProxy():
        return None
    while prim.IsInstanceProxy():
        prim = prim.GetParent()
    return prim


def meshes_below(prim: Usd.Prim) -> tuple[Usd.Prim, ...]:
    """The prim if it is a mesh, and meshes below it, those of instances and of prototypes below an over included."""
    found = Usd.PrimRange(prim, Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded & ~Usd.PrimIsAbstract))
    return tuple(p for p in found if p.IsA(UsdGeom.Mesh) and p.HasDefiningSpecifier())


def _checked_subset(subset: UsdGeom.Subset) -> Usd.Prim:
    prim = subset.GetPrim()
    place = site(prim.GetStage(), prim)
    if subset.GetElementTypeAttr().Get() != UsdGeom.Tokens.face:
        kind = subset.GetElementTypeAttr().Get()
        raise UsdfabError(f"the subset is one of {kind}s", place=place, remedy="materials go on subsets of faces")
    if not prim.GetParent().IsA(UsdGeom.Mesh):
        raise UsdfabError("the subset is not one of a mesh", place=place)
    return prim


# --- collections -----------------------------------------------------------------------------------------------------


def collection_target(stage: Usd.Stage, text: str) -> Target:
    """The collection ``/Prim.collection:name`` (``/Prim:name`` will do).

    The binding goes on the collection's prim where that has all members below it, else on their common ancestor: a
    collection binding reaches only what is below the prim that carries it.

    Raises
    ------
    UsdfabError
        If there is no such prim or collection, or there is no mesh in it.
    """
    owner, separator, name = text.partition(".collection:")
    if not separator:
        owner, _, name = text.partition(":")
    prim = existing(stage, owner)
    names = [c.GetName() for c in Usd.CollectionAPI.GetAll(prim)]
    place = f"{stage_name(stage)}<{text}>"
    if name not in names:
        remedy = f"the prim has {', '.join(names)}" if names else "the prim has no collections"
        raise UsdfabError("there is no such collection", place=place, remedy=remedy)
    collection = Usd.CollectionAPI(prim, name)
    query = collection.ComputeMembershipQuery()
    predicate = Usd.TraverseInstanceProxies()
    paths = Usd.CollectionAPI.ComputeIncludedPaths(query, stage, predicate)
    meshes = []
    for path in paths:
        member = stage.GetPrimAtPath(path)
        if member and member.IsA(UsdGeom.Mesh):
            meshes.append(member)
    if not meshes:
        raise UsdfabError("there is no mesh in the collection", place=place, remedy=candidates_text(stage))
    common = prim.GetPath()
    for mesh in meshes:
        common = common.GetCommonPrefix(mesh.GetPath())
    if common.IsAbsoluteRootPath():
        remedy = "bind the members by --prim"
        raise UsdfabError("the collection's meshes and its prim have no common ancestor", place=place, remedy=remedy)
    carrier = existing(stage, str(common))
    return Target(carrier, tuple(meshes), prim.GetPath().AppendProperty(f"collection:{name}"))


# --- candidates ------------------------------------------------------------------------------------------------------


def candidates(stage: Usd.Stage) -> list[Usd.Prim]:
    """What looks most like cloth among the meshes that are drawn; an instance stands for the meshes in it.

    Meshes with texture coordinates and no material; if none is, those without material; then with coordinates; then
    all.
    """
    meshes = [p for p in drawn_prims(stage, Usd.TimeCode.EarliestTime()) if p.IsA(UsdGeom.Mesh)]
    for wanted in (
        [m for m in meshes if _has_uv(m) and not _has_material(m)],
        [m for m in meshes if not _has_material(m)],
        [m for m in meshes if _has_uv(m)],
    ):
        if wanted:
            meshes = wanted
            break
    return list(dict.fromkeys(instance_root(m) or m for m in meshes))


def default_targets(stage: Usd.Stage, *, every: bool) -> list[Target]:
    """The only candidate, or with ``every`` all of them.

    Raises
    ------
    UsdfabError
        If there is no mesh, or without ``every`` more than one candidate; they are listed.
    """
    found = candidates(stage)
    if not found:
        raise UsdfabError("there is no visible mesh in this stage", place=stage_name(stage))
    if len(found) > 1 and not every:
        remedy = f"choose with --prim, or bind all with --all: {listed(str(p.GetPath()) for p in found)}"
        raise UsdfabError(f"{len(found)} meshes could be cloth", place=stage_name(stage), remedy=remedy)
    return [Target(p, meshes_below(p)) for p in found]


def candidates_text(stage: Usd.Stage) -> str:
    """Half a sentence that names what looks like cloth."""
    found = [str(p.GetPath()) for p in candidates(stage)]
    return f"cloth could be {listed(found)}" if found else "the stage has no visible mesh"


def listed(paths: Iterable[str]) -> str:
    """Paths for people: the first few, and how many more."""
    known = list(paths)
    more = f" and {len(known) - MAX_LISTED} more" if len(known) > MAX_LISTED else ""
    return ", ".join(known[:MAX_LISTED]) + more


def _nearest(stage: Usd.Stage, path: str) -> str:
    known: Sequence[str] = [str(p.GetPath()) for p in stage.TraverseAll()]
    near = difflib.get_close_matches(path, known, n=3, cutoff=0.7)
    return f"did you mean {' or '.join(near)}?" if near else candidates_text(stage)


def _has_uv(prim: Usd.Prim) -> bool:
    api = UsdGeom.PrimvarsAPI(prim)
    role = Sdf.ValueRoleNames.TextureCoordinate
    return any(api.HasPrimvar(n) for n in UV_NAMES) or any(
        p.GetTypeName().role == role for p in api.GetPrimvarsWithValues()
    )


def _has_material(prim: Usd.Prim) -> bool:
    prims = [prim, *(s.GetPrim() for s in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets())]
    return any(UsdShade.MaterialBindingAPI(p).ComputeBoundMaterial()[0] for p in prims)
