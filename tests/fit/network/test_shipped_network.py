"""The weights that ship: whole, credited, and good on cloth that neither the renderer nor usdfab's drawing has made."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import torch
from cloth_drawing import Cloth, draw

from usdfab.errors import UsdfabError
from usdfab.fabric.weave import NAMED_WEAVES
from usdfab.fit.network import network_file
from usdfab.fit.network.inputs import feature_net
from usdfab.fit.network.labels import family_of
from usdfab.fit.network.model import Robust
from usdfab.fit.network.network_file import Weights, load_network
from usdfab.fit.network.predict import predict


@pytest.fixture(scope="module")
def shipped() -> Weights:
    return load_network()


def test_the_shipped_network_is_the_one_on_its_card(shipped: Weights) -> None:
    digest = hashlib.sha256(network_file.SHIPPED.read_bytes()).hexdigest()
    assert digest == network_file.SHIPPED_SHA256
    card = network_file.SHIPPED.with_suffix(".md").read_text(encoding="utf-8")
    data = shipped.about["data"]
    assert digest in card and isinstance(shipped.network, Robust)
    for said in (f"{data['training_samples']} rendered", f"{data['drawn']} drawn", f"{data['spp']} sample"):
        assert said in card
    assert network_file.SHIPPED.stat().st_size < 3e6


def test_damage_is_noticed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    content = bytearray(network_file.SHIPPED.read_bytes())
    content[-100] ^= 1
    changed = tmp_path / "weights.safetensors"
    changed.write_bytes(content)
    monkeypatch.setattr(network_file, "SHIPPED", changed)
    with pytest.raises(UsdfabError, match="wrong checksum"):
        load_network()
    changed.unlink()
    with pytest.raises(UsdfabError, match="no such file"):
        load_network()


@pytest.mark.parametrize(
    ("weave", "warp", "weft"), [("plain", 10.0, 12.0), ("twill0", 12.0, 14.0), ("satin", 16.0, 14.0)]
)
def test_drawn_cloth(shipped: Weights, weave: str, warp: float, weft: float) -> None:
    found = predict(draw(Cloth(NAMED_WEAVES[weave].matrix, warp, weft)), shipped)
    assert found.counts.tolist() == pytest.approx([warp, weft], rel=0.05)
    assert family_of(found.label) == family_of(weave)


def test_both_precisions_say_the_same(shipped: Weights) -> None:
    photo = draw(Cloth(NAMED_WEAVES["plain"].matrix, 9.0, 11.0))
    half, full = (predict(photo, shipped, feature_net(dtype)) for dtype in (torch.bfloat16, torch.float32))
    assert abs(half.values - full.values).max() < 0.25 * full.sigma.max()
    assert (abs(half.values - full.values) / full.sigma).max() < 0.3
    assert abs(half.weave - full.weave).max() < 0.1
