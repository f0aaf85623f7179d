"""What the network learns from, computed once: numbers of every view of every sample, a small file for each sample.

Files appear whole or not at all, so an interrupted run goes on where it was. A file that belongs to another picture or
other inputs is refused, not used.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from torch import Tensor

from usdfab.disk import refused
from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.files import whole_file
from usdfab.fit.dataset.reader import Stored, read_dataset
from usdfab.fit.dataset.settings import Settings, settings_of
from usdfab.fit.dataset.store import MANIFEST, read_manifest
from usdfab.fit.features import FeatureNet
from usdfab.fit.network.detail import DETAIL_SIZE, REVISION as DETAIL_REVISION, detail_vector, rectified
from usdfab.fit.network.drawn import REVISION as DRAWN_REVISION, drawn_cloth
from usdfab.fit.network.inputs import LEVELS, REVISION as INPUT_REVISION, Basis, fitted_basis, prepared, texture_vectors
from usdfab.fit.network.labels import LABELS, weave_label
from usdfab.fit.network.spectra import BINS, LATTICE_SIZE, axis_spectra, lattice_spectrum, refined, texture_maps
from usdfab.fit.network.splits import split_of
from usdfab.fit.network.targets import encode, targets_hash
from usdfab.fit.network.views import REVISION as VIEW_REVISION, as_photographed, view

FORMAT = "usdfab-network-inputs/2"
BASIS = "basis.safetensors"
BASIS_PICTURES = 48
"""Pictures of the training part from which the channels' components come."""

HINT_SIGMA = 0.02
"""Relative error of the counts by which the lattice spectrum is found in training; with a network they are its own."""

DRAWN_CHUNK = 50

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Rows:
    """Views as arrays, R rows, ordered by sample and view.

    Parameters
    ----------
    index, number: (R,) int64
        Sample and view.
    table4: (R,) bool
        Whether the fabric comes from Table 4 of Li et al. 2024; else from the wide prior.
    texture: (R, D), detail: (R, DETAIL_SIZE) float32
        Of the rectified picture, see ``inputs.texture_vectors`` and ``detail.detail_vector``.
    spectra: (R, 2, 3, BINS), lattice: (R, LATTICE_SIZE) float32
        See ``spectra.axis_spectra`` and ``spectra.lattice_spectrum``.
    whole: (R, D) float32
        The texture vector of the picture as it is, for the paper's network; 0 for what that does not look at.
    values: (R, 2, P) float32, known: (R, 2, P) bool
        See ``targets.encode``.
    label: (R,) int64
        Number in ``LABELS``.
    """

    index: Tensor
    number: Tensor
    table4: Tensor
    texture: Tensor
    detail: Tensor
    whole: Tensor
    spectra: Tensor
    lattice: Tensor
    values: Tensor
    known: Tensor
    label: Tensor

    def __len__(self) -> int:
        return len(self.index)

    def where(self, chosen: Tensor) -> Rows:
        """The rows of a mask (R,) or of indices."""
        return Rows(**{name: getattr(self, name)[chosen] for name in self.__dataclass_fields__})

    def of(self, part: str) -> Rows:
        """The rows of one of ``splits.PARTS``."""
        return self.where(torch.tensor([split_of(int(i)) == part for i in self.index], dtype=torch.bool))


@dataclass(frozen=True, eq=False)
class Prepared:
    """A data set as the network sees it, drawn cloth beside it. ``settings`` are the data set's; ``place`` names it."""

    settings: Settings
    basis: Basis
    rows: Rows
    place: str
    drawn: Drawn | None = None

    @property
    def samples(self) -> int:
        """How many pictures there are."""
        return len(self.rows.index.unique())


def prepare(
    dataset: str | Path,
    folder: str | Path,
    net: FeatureNet,
    views: int = 8,
    *,
    basis: Basis | None = None,
    limit: int | None = None,
    progress: Progress | None = None,
) -> Prepared:
    """Compute what is not in ``folder`` yet, and read all of it.

    Parameters
    ----------
    dataset:
        Folder of ``usdfab dataset fabrics``; may still grow.
    views:
        Of each sample; the first is the render itself.
    basis:
        To use, of a network that is there; by default the folder's, or a new one.
    limit:
        Only the first so many samples.

    Raises
    ------
    UsdfabError
        If the data set is damaged, empty, or of another parameter table; the folder holds something else; the disk
        refuses. What was computed is kept.
    """
    if views < 1:
        raise UsdfabError(f"{views} views are none", place="--views", remedy="give 1 or more")
    root, target = Path(dataset), Path(folder)
    settings = settings_of(read_manifest(root), str(root / MANIFEST))
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refused(error, target) from error
    stored = list(islice(read_dataset(root), limit))
    if not stored:
        raise UsdfabError("there are no samples in the data set", place=str(root))
    if basis is None:
        basis = _kept_basis(target / BASIS, net, stored)
    parts: list[dict[str, NDArray]] = []
    for done, sample in enumerate(stored):
        if progress:
            progress(done, len(stored))
        parts.append(_sample(sample, target, net, basis, views))
    if progress:
        progress(len(stored), len(stored))
    return Prepared(settings, basis, _rows(parts), str(root))


def _kept_basis(path: Path, net: FeatureNet, stored: list[Stored]) -> Basis:
    if path.exists():
        tensors, _ = _read(path, {"format": FORMAT, "kind": "basis"})
        return Basis.from_tensors({name: torch.from_numpy(value) for name, value in tensors.items()})
    chosen = [s for s in stored if split_of(s.index) == "train"][:BASIS_PICTURES] or stored[:BASIS_PICTURES]
    basis = fitted_basis(net, [_upright(prepared(s.image), s.sample.fabric) for s in chosen])
    about = {"format": FORMAT, "kind": "basis", "pictures": str(len(chosen))}
    _write(path, {name: tensor.numpy() for name, tensor in basis.tensors().items()}, about)
    return basis


def _upright(picture: NDArray[np.float32], fabric: FabricParameters) -> NDArray[np.float32]:
    """The rectified picture of a fabric whose counts are known."""
    return rectified(picture, *refined(texture_maps(picture), (fabric.warp.count, fabric.weft.count)))


def _sample(stored: Stored, folder: Path, net: FeatureNet, basis: Basis, views: int) -> dict[str, NDArray]:
    """All views of a sample, from its file or computed."""
    path = folder / f"{stored.index:06d}.safetensors"
    about = {
        "format": FORMAT, "kind": "sample", "image": stored.record["image_sha256"], "basis": basis.checksum(),
        "targets": targets_hash(), "labels": json.dumps(LABELS),
        "revision": json.dumps([VIEW_REVISION, INPUT_REVISION, DETAIL_REVISION]),
    }  # fmt: skip
    found: dict[str, NDArray] = {}
    if path.exists():
        found, _ = _read(path, about)
        if len(found["number"]) >= views:
            return {name: value[:views] for name, value in found.items()}
    sample, image = stored.sample, stored.image
    numbers = range(len(found["number"]) if found else 0, views)
    shown = [view(image, sample.fabric, stored.index, number) for number in numbers]
    new = []
    for number, (picture, fabric) in zip(numbers, shown, strict=True):
        maps = texture_maps(picture)
        values, known = encode(fabric)
        rng = np.random.default_rng([stored.index, number, 1])
        warp, weft = (float(c * np.exp(rng.normal(0.0, HINT_SIGMA))) for c in (fabric.warp.count, fabric.weft.count))
        found_at = refined(maps, (warp, weft))
        upright = rectified(picture, *found_at)
        texture = texture_vectors(net, basis, upright[None])[0]
        table4 = sample.prior == "paper"
        whole = texture_vectors(net, basis, picture[None])[0] if table4 and number == 0 else np.zeros_like(texture)
        new.append(
            {
                "index": np.int64(stored.index), "number": np.int64(number), "table4": np.bool_(table4),
                "texture": texture.astype(np.float16), "whole": whole.astype(np.float16),
                "detail": detail_vector(upright).astype(np.float16), "spectra": axis_spectra(maps).astype(np.float16),
                "lattice": lattice_spectrum(maps, *found_at).ravel().astype(np.float16),
                "values": values.astype(np.float32), "known": known,
                "label": np.int64(LABELS.index(weave_label(fabric.weave))),
            }
        )  # fmt: skip
    joined = {name: np.stack([np.asarray(row[name]) for row in new]) for name in new[0]}
    if found:
        joined = {name: np.concatenate([found[name], value]) for name, value in joined.items()}
    _write(path, joined, about)
    return joined


def _rows(parts: list[dict[str, NDArray]]) -> Rows:
    def joined(name: str) -> Tensor:
        tensor = torch.from_numpy(np.concatenate([part[name] for part in parts]))
        return tensor.float() if tensor.is_floating_point() else tensor

    rows = Rows(**{name: joined(name) for name in Rows.__dataclass_fields__})
    sized = (rows.lattice.shape[1], rows.detail.shape[1]) == (LATTICE_SIZE, DETAIL_SIZE)
    checked = ("texture", "detail", "whole", "spectra", "lattice", "values")
    if not sized or not all(getattr(rows, name).isfinite().all() for name in checked):
        raise UsdfabError("the inputs hold numbers that are not finite, or too few", remedy="remove their folder")
    return rows


@dataclass(frozen=True, eq=False)
class Drawn:
    """Drawn cloth for what reads lattices, R pictures; see ``Rows``. ``counts`` (R, 2) are log counts."""

    spectra: Tensor
    lattice: Tensor
    counts: Tensor
    label: Tensor

    def __len__(self) -> int:
        return len(self.label)


def draw_inputs(folder: str | Path, count: int, progress: Progress | None = None) -> Drawn:
    """Inputs of ``count`` drawn cloths, kept in ``folder`` in files of ``DRAWN_CHUNK``; rounded up to whole files.

    Raises
    ------
    UsdfabError
        If a file there is something else or the disk refuses.
    """
    if count < 0:
        raise UsdfabError(f"{count} drawn cloths cannot be", place="--drawn", remedy="give 0 or more")
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refused(error, target) from error
    chunks = -(-count // DRAWN_CHUNK)
    parts = []
    for chunk in range(chunks):
        if progress:
            progress(chunk, chunks)
        parts.append(_drawn_chunk(target / f"drawn-{chunk:04d}.safetensors", chunk))

    def joined(name: str, shape: tuple[int, ...]) -> Tensor:
        tensor = torch.from_numpy(np.concatenate([p[name] for p in parts]) if parts else np.zeros((0, *shape)))
        return tensor.long() if name == "label" else tensor.float()

    return Drawn(
        joined("spectra", (2, 3, BINS)), joined("lattice", (LATTICE_SIZE,)), joined("counts", (2,)), joined("label", ())
    )


def _drawn_chunk(path: Path, chunk: int) -> dict[str, NDArray]:
    about = {
        "format": FORMAT, "kind": "drawn", "chunk": str(chunk), "labels": json.dumps(LABELS),
        "revision": json.dumps([DRAWN_REVISION, VIEW_REVISION, INPUT_REVISION]),
    }  # fmt: skip
    if path.exists():
        return _read(path, about)[0]
    rows = []
    for number in range(chunk * DRAWN_CHUNK, (chunk + 1) * DRAWN_CHUNK):
        rng = np.random.default_rng([number, 2])
        pixels, fabric = drawn_cloth(rng)
        maps = texture_maps(prepared(as_photographed(pixels, fabric, rng)))
        counts = np.array([fabric.warp.count, fabric.weft.count])
        warp, weft = (float(c) for c in counts * np.exp(rng.normal(0.0, HINT_SIGMA, 2)))
        rows.append(
            {
                "spectra": axis_spectra(maps).astype(np.float16), "counts": np.log(counts).astype(np.float32),
                "lattice": lattice_spectrum(maps, *refined(maps, (warp, weft))).ravel().astype(np.float16),
                "label": np.int64(LABELS.index(weave_label(fabric.weave))),
            }
        )  # fmt: skip
    joined = {name: np.stack([np.asarray(row[name]) for row in rows]) for name in rows[0]}
    _write(path, joined, about)
    return joined


def component_counts(basis: Basis) -> tuple[int, ...]:
    """Components at each level and tap, in the order of texture vectors."""
    return tuple(d.shape[1] for d in basis.directions) * len(LEVELS)


def _read(path: Path, about: dict[str, str]) -> tuple[dict[str, NDArray], dict[str, str]]:
    try:
        with safe_open(path, "numpy") as file:
            said = file.metadata() or {}
            found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise UsdfabError("the inputs are damaged", place=str(path), remedy="remove the file and run again") from error
    differ = [name for name, value in about.items() if said.get(name) != value]
    if differ:
        raise UsdfabError(
            f"the inputs were made otherwise ({', '.join(differ)})", place=str(path),
            remedy="remove the folder, or name another with --inputs",
        )  # fmt: skip
    return found, said


def _write(path: Path, arrays: dict[str, Any], about: dict[str, str]) -> None:
    try:
        with whole_file(path) as temporary:
            save_file({name: np.ascontiguousarray(a) for name, a in arrays.items()}, temporary, about)
    except (OSError, SafetensorError) as error:
        raise refused(error, path) from error
