"""Rows without pictures, a small feature network, and a data set of drawn cloth, for the tests of the network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from cloth_drawing import Cloth, draw
from small_network import small_net

from usdfab.fit.dataset.records import sample_record
from usdfab.fit.dataset.render import encode_image
from usdfab.fit.dataset.samples import draw_sample
from usdfab.fit.dataset.settings import Settings
from usdfab.fit.dataset.store import Store
from usdfab.fit.features import FeatureNet
from usdfab.fit.network.detail import DETAIL_SIZE
from usdfab.fit.network.inputs import Basis
from usdfab.fit.network.labels import LABELS
from usdfab.fit.network.spectra import BINS, FREQUENCIES, LATTICE_SIZE
from usdfab.fit.network.store import Drawn, Prepared, Rows
from usdfab.fit.network.targets import TARGETS

COMPONENTS = (3, 2)
TEXTURE = 3 * sum(q + q * (q + 1) // 2 for q in COMPONENTS)


def basis() -> Basis:
    """Of a network with 4 and 6 channels, such as ``net``."""
    rng = np.random.default_rng(1)
    shapes = [(4, COMPONENTS[0]), (6, COMPONENTS[1])]
    return Basis(
        tuple(torch.from_numpy(rng.normal(size=s[0])).float() for s in shapes),
        tuple(torch.from_numpy(rng.normal(size=s)).half().float() for s in shapes),
    )


def rows(samples: int = 60, views: int = 2, seed: int = 0) -> Rows:
    """Rows: the lattice tells the weave, lattice and detail the irregularity, a peak of the spectra the counts."""
    rng = np.random.default_rng(seed)
    count = samples * views
    index = np.repeat(np.arange(samples), views)
    label = rng.integers(len(LABELS), size=count)
    label = np.where(index % 2 == 0, label % 7, label)
    values = rng.normal(size=(count, 2, len(TARGETS)))
    values[:, :, 0] = np.log(rng.uniform(6.0, 30.0, (count, 2)))
    spectra = 0.1 * rng.normal(size=(count, 2, 3, BINS))
    spectra += 5.0 * np.exp(-0.5 * ((np.log(FREQUENCIES) - values[:, :, None, :1]) / 0.05) ** 2)
    patterns = np.random.default_rng(5).normal(size=(len(LABELS) + 2, LATTICE_SIZE))
    lattice = rng.normal(size=(count, LATTICE_SIZE)) + patterns[label] + values[:, :, 9] @ patterns[-2:]
    # Positive definite covariances, as pictures have them.
    texture = []
    for q in COMPONENTS * 3:
        parts = rng.normal(size=(count, 20, q))
        middle = parts.mean(axis=1)
        covariance = np.einsum("bni,bnj->bij", parts, parts) / 20
        rows_, columns = np.triu_indices(q)
        texture += [middle, covariance[:, rows_, columns]]
    vector = np.concatenate(texture, axis=1)
    signs = np.random.default_rng(6).normal(size=(2, DETAIL_SIZE))
    detail = rng.normal(size=(count, DETAIL_SIZE)) + values[:, :, 9] @ signs
    as_float = {
        "texture": vector, "whole": vector, "detail": detail, "spectra": spectra, "lattice": lattice, "values": values
    }  # fmt: skip
    return Rows(
        index=torch.from_numpy(index),
        number=torch.arange(count) % views,
        table4=torch.from_numpy(index % 2 == 0),
        label=torch.from_numpy(label),
        known=torch.ones(count, 2, len(TARGETS), dtype=torch.bool),
        **{name: torch.from_numpy(value).float() for name, value in as_float.items()},
    )


def drawn_rows(count: int = 100) -> Drawn:
    """The same signs without the texture."""
    some = rows(count, 1, seed=4)
    return Drawn(some.spectra, some.lattice, some.values[:, :, 0], some.label)


def prepared_rows(samples: int = 60, views: int = 2) -> Prepared:
    """The same as a data set."""
    return Prepared(Settings(size=64), basis(), rows(samples, views), "drawn")


def net(folder: Path) -> FeatureNet:
    """A network of VGG's kind with 4 and 6 channels."""
    return small_net(folder, torch.float32, pooling="maximum")


def drawn_dataset(root: Path, count: int = 12) -> Settings:
    """A data set whose pictures are drawn, not rendered: count and weave are those of the records."""
    settings = Settings(prior="both", seed=1, size=64, spp=1, shard=256)
    store = Store(root, settings)
    for index in range(count):
        sample = draw_sample(settings.prior, settings.seed, index)
        fabric = sample.fabric
        cloth = Cloth(fabric.weave.matrix, fabric.warp.count, fabric.weft.count, seed=index, size=64)
        image = encode_image(draw(cloth).astype(np.float32))
        store.commit(index, sample_record(sample, settings.rendering(), image), image)
    return settings
