"""Spectra of drawn cloth show its counts and its weave; texture vectors equal NumPy's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from cloth_drawing import Cloth, draw
from network_examples import net

from usdfab.errors import UsdfabError
from usdfab.fabric.weave import NAMED_WEAVES
from usdfab.fit.network import store
from usdfab.fit.network.drawn import drawn_cloth
from usdfab.fit.network.inputs import BRIGHTNESS, LEVELS, even, fitted_basis, gram, prepared, texture_vectors
from usdfab.fit.network.spectra import (
    BINS,
    FREQUENCIES,
    LATTICE_SHAPE,
    LATTICE_SIZE,
    axis_spectra,
    lattice_spectrum,
    refined,
    texture_maps,
    turned_maps,
)
from usdfab.fit.network.turns import TURNS


def drawn(weave: str, warp: float, weft: float, rotation: float = 0.0, seed: int = 0) -> np.ndarray:
    cloth = Cloth(NAMED_WEAVES[weave].matrix, warp, weft, rotation=rotation, seed=seed, wobble=0.03)
    return prepared(draw(cloth))


@pytest.mark.parametrize(("warp", "weft", "rotation"), [(9.3, 14.2, 0.06), (12.0, 10.0, -0.05), (24.0, 20.0, 0.0)])
def test_frequencies_of_drawn_cloth(warp: float, weft: float, rotation: float) -> None:
    maps = texture_maps(drawn("plain", warp, weft, rotation))
    peaks = FREQUENCIES[axis_spectra(maps).sum(axis=1).argmax(axis=1)]
    # Sharp yarn borders may make the second harmonic the strongest.
    for peak, count in zip(peaks, (warp, weft), strict=True):
        assert min(abs(peak / count - 1.0), abs(peak / (2.0 * count) - 1.0)) < 0.06
    found = refined(maps, (1.04 * warp, 0.96 * weft))
    for one, count in zip(found, (warp, weft), strict=True):
        assert one.cycles * np.cos(rotation) == pytest.approx(count, rel=0.03)
        assert one.tilt == pytest.approx(rotation, abs=np.radians(1.5))


@pytest.mark.parametrize(
    ("weave", "where"),
    [("plain", (0.5, 0.5)), ("twill0", (1 / 3, 1 / 3)), ("twill_2_2", (0.25, 0.25)), ("satin", (0.2, 0.4))],
)
def test_the_lattice_shows_the_weave_at_any_scale(weave: str, where: tuple[float, float]) -> None:
    for warp, weft in ((11.0, 14.0), (16.0, 20.0)):
        maps = texture_maps(drawn(weave, warp, weft, 0.04))
        spectrum = lattice_spectrum(maps, *refined(maps, (warp, weft)))
        assert spectrum.shape == LATTICE_SHAPE
        # The fiber direction says which yarn is on top.
        power = np.exp(spectrum[1])
        u = (2 * np.arange(LATTICE_SHAPE[1]) + 0.5) / 32
        v = (2 * np.arange(LATTICE_SHAPE[2]) - LATTICE_SHAPE[2] + 0.5) / 32
        inside = (u[:, None] < 0.75) & (np.abs(v) < 0.75) & (np.hypot(u[:, None], v) > 0.12)
        i, j = np.unravel_index(int(np.where(inside, power, 0.0).argmax()), power.shape)
        candidates = {where, (where[1], where[0])} if weave == "satin" else {where}
        near = [max(abs(u[i] - a), abs(abs(v[j]) - b)) for a, b in candidates]
        # A satin's lattice has several shortest vectors: (1/5, 2/5) and (2/5, 1/5).
        assert min(near) < 0.07


@pytest.mark.parametrize("turn", TURNS[1:])
def test_turned_maps_are_the_maps_of_the_turned_picture(turn) -> None:  # type: ignore[no-untyped-def]
    picture = drawn("twill0", 12.0, 15.0, 0.03)
    maps = texture_maps(picture)
    direct = texture_maps(np.ascontiguousarray(turn.picture(picture)))
    quick = turned_maps(maps, turn)
    sign = -1.0 if turn.quarters % 2 else 1.0
    np.testing.assert_allclose(quick[[0, 2]], direct[[0, 2]], atol=1e-6)
    np.testing.assert_allclose(quick[1], sign * direct[1], atol=1e-6)
    found = refined(maps, (12.0, 15.0))
    warp, weft = (f.turned(turn) for f in (found if turn.quarters % 2 == 0 else found[::-1]))
    again = refined(direct, (warp.cycles, weft.cycles))
    for a, b in zip((warp, weft), again, strict=True):
        assert a.cycles == pytest.approx(b.cycles, rel=0.01) and a.tilt == pytest.approx(b.tilt, abs=0.02)
    spectra = axis_spectra(maps)
    expected = spectra[::-1] if turn.quarters % 2 else spectra
    np.testing.assert_allclose(axis_spectra(direct), expected, atol=0.3)


def test_texture_vectors_equal_numpy(tmp_path: Path) -> None:
    network = net(tmp_path)
    pictures = np.stack([drawn("plain", 9.0, 9.0, seed=k) for k in range(2)])
    basis = fitted_basis(network, pictures)
    found = texture_vectors(network, basis, pictures)
    assert found.shape == (2, basis.texture_size)
    image = torch.from_numpy(pictures[1:]).permute(0, 3, 1, 2)
    expected, grams = [], []
    for level in LEVELS:
        small = image if level == 1 else torch.nn.functional.avg_pool2d(image, level)
        for tap, mean, directions in zip(network(small), basis.mean, basis.directions, strict=True):
            x = (tap[0].flatten(1).T.numpy() - mean.numpy()) @ directions.numpy()
            covariance = np.cov(x.T, bias=True)
            upper = np.triu_indices(len(covariance))
            expected += [x.mean(axis=0), covariance[upper]]
            grams.append((x.T @ x / len(x))[upper])
    np.testing.assert_allclose(found[1], np.concatenate(expected), atol=2e-4, rtol=1e-3)
    components = tuple(d.shape[1] for d in basis.directions) * len(LEVELS)
    whole = gram(torch.from_numpy(found), components)
    np.testing.assert_allclose(whole[1].numpy(), np.concatenate(grams), atol=2e-4, rtol=1e-3)


def test_the_basis_whitens_the_pictures_it_was_fitted_to(tmp_path: Path) -> None:
    network = net(tmp_path)
    pictures = [drawn("satin", 9.0, 12.0, seed=k) for k in range(2)]
    basis = fitted_basis(network, pictures)
    image = torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2)
    scales = [image if level == 1 else torch.nn.functional.avg_pool2d(image, level) for level in LEVELS]
    for k, (mean, directions) in enumerate(zip(basis.mean, basis.directions, strict=True)):
        columns = torch.cat([network(s)[k].permute(0, 2, 3, 1).flatten(0, 2) for s in scales])
        x = (columns - mean) @ directions
        np.testing.assert_allclose((x.T @ x / len(x)).numpy(), np.eye(x.shape[1]), atol=0.02)


def test_even_statistics_have_unit_correlations() -> None:
    covariance = torch.tensor([[4.0, 1.0], [1.0, 9.0]])
    texture = torch.tensor([[0.5, -0.5, 4.0, 1.0, 9.0]])
    found = even(texture, (2,))[0]
    expected = [0.5, -0.5, np.log(2.0), np.log(3.0), float(covariance[0, 1]) / 6.0]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6)
    with pytest.raises(UsdfabError, match="numbers"):
        even(texture[:, :4], (2,))


def test_drawn_cloth_shows_the_fabric_that_it_is_said_to_show() -> None:
    """Its crossings have the colours of the yarns that the weave puts on top; the analysis reads its counts."""
    counted = 0
    for seed in range(4):
        pixels, fabric = drawn_cloth(np.random.default_rng(seed))
        again, same = drawn_cloth(np.random.default_rng(seed))
        np.testing.assert_array_equal(pixels, again)
        assert fabric == same and pixels.shape == (256, 256, 3) and np.isfinite(pixels).all() and pixels.min() >= 0.0
        maps = texture_maps(prepared(pixels))
        for frequency, yarn in zip(refined(maps, (fabric.warp.count, fabric.weft.count)), (fabric.warp, fabric.weft),
                                   strict=True):  # fmt: skip
            counted += abs(frequency.cycles / yarn.count - 1.0) < 0.03
    assert counted >= 7


def test_drawn_inputs_are_kept_and_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "DRAWN_CHUNK", 2)
    first = store.draw_inputs(tmp_path, 3)
    assert len(first) == 4 and first.spectra.shape == (4, 2, 3, BINS) and first.lattice.shape == (4, LATTICE_SIZE)
    monkeypatch.setattr(store, "drawn_cloth", None)
    again = store.draw_inputs(tmp_path, 4)
    assert torch.equal(first.lattice, again.lattice) and torch.equal(first.label, again.label)
    assert len(store.draw_inputs(tmp_path, 0)) == 0
    with pytest.raises(UsdfabError, match="drawn cloths cannot be"):
        store.draw_inputs(tmp_path, -1)
    (tmp_path / "drawn-0001.safetensors").write_bytes((tmp_path / "drawn-0000.safetensors").read_bytes())
    with pytest.raises(UsdfabError, match="made otherwise"):
        store.draw_inputs(tmp_path, 4)


def test_prepared_pictures_are_square_and_evenly_bright() -> None:
    rng = np.random.default_rng(0)
    wide = rng.uniform(0.0, 1.0, (100, 160, 3))
    found = prepared(wide)
    assert found.shape == (256, 256, 3) and found.dtype == np.float32
    assert float((found @ np.array([0.2126, 0.7152, 0.0722])).mean()) == pytest.approx(BRIGHTNESS, rel=1e-3)
    np.testing.assert_allclose(found, prepared(7.0 * wide[:, 30:130]), rtol=1e-3, atol=1e-5)
    for bad, said in (
        (wide[..., :2], "RGB"), (wide[:30], "too few"), (0.0 * wide, "black"), (wide * np.nan, "not finite"),
    ):  # fmt: skip
        with pytest.raises(UsdfabError, match=said):
            prepared(bad)
