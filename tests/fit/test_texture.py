"""Texture statistics and losses: against NumPy, finite differences, and what they must not see."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from small_network import picture, small_net

from usdfab.errors import UsdfabError
from usdfab.fit.features import load_features
from usdfab.fit.losses import roughness_prior
from usdfab.fit.texture import (
    Kind,
    Target,
    color_loss,
    gram_matrix,
    mean_and_covariance,
    reduced,
    residual_weights,
    residuals,
    rolled_off,
    texture_loss,
    texture_statistics,
)

KINDS: tuple[Kind, ...] = ("gram", "covariance")


def test_statistics_equal_numpy() -> None:
    maps = torch.randn(2, 5, 6, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gram = gram_matrix(maps)
    mean, covariance = mean_and_covariance(maps)
    for image in range(2):
        rows = maps[image].numpy().reshape(5, 42)
        slow = np.array([[sum(rows[a, p] * rows[b, p] for p in range(42)) / 42 for b in range(5)] for a in range(5)])
        np.testing.assert_allclose(gram[image], slow, atol=1e-13)
        np.testing.assert_allclose(mean[image], rows.mean(axis=1), atol=1e-13)
        np.testing.assert_allclose(covariance[image], np.cov(rows, bias=True), atol=1e-13)


def test_the_gram_loss_by_hand(tmp_path: Path) -> None:
    net = small_net(tmp_path)
    a, b = picture(1), picture(2)
    terms = []
    for level in (1, 2):
        blocks = [x.numpy().reshape(1, 3, 32 // level, level, 32 // level, level).mean(axis=(3, 5)) for x in (a, b)]
        for f, g in zip(*(net(torch.tensor(x)) for x in blocks), strict=True):
            grams = [np.einsum("chw,dhw->cd", m[0], m[0]) / m[0, 0].numpy().size for m in (f, g)]
            terms.append(np.abs(grams[0] - grams[1]).mean() / np.abs(grams[1]).mean())
    target = Target.from_image(b, net, (1, 2), "gram")
    assert float(texture_loss(a, target)) == pytest.approx(np.mean(terms), rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_weighted_residuals_add_up_to_the_losses(tmp_path: Path, kind: Kind) -> None:
    net = small_net(tmp_path)
    target = Target.from_image(picture(1), net, (1, 2), kind)
    found, weights = residuals(picture(2), target), residual_weights(target, 0.7, 1.3)
    whole = 0.7 * texture_loss(picture(2), target) + 1.3 * color_loss(picture(2), target)
    assert float(found.abs() @ weights) == pytest.approx(float(whole), rel=1e-5)
    assert residuals(picture(1), target).abs().max() == 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_equal_finite_differences(tmp_path: Path, kind: Kind) -> None:
    net = small_net(tmp_path)
    target = Target.from_image(picture(1), net, (1, 2), kind)
    image = picture(2, 12, 12).requires_grad_(True)

    def losses(x: torch.Tensor) -> torch.Tensor:
        return texture_loss(1.6 * x, target) + color_loss(1.6 * x, target)  # with some light above 1

    assert (1.6 * image > 1.0).sum() > 5
    assert torch.autograd.gradcheck(losses, (image,), eps=1e-7, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_shipped_network_s_gradient_along_a_direction(kind: Kind) -> None:
    net = load_features(dtype=torch.float64)
    target = Target.from_image(picture(1, 16, 16), net, (2,), kind)
    image = picture(2, 16, 16).requires_grad_(True)
    direction = picture(3, 16, 16) - 0.5
    (gradient,) = torch.autograd.grad(texture_loss(image, target), image)
    with torch.no_grad():
        step = 1e-6
        rise = texture_loss(image + step * direction, target) - texture_loss(image - step * direction, target)
    assert float((gradient * direction).sum()) == pytest.approx(float(rise) / (2 * step), rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_same_image_has_no_loss_and_another_has(kind: Kind, dtype: torch.dtype) -> None:
    net = load_features(dtype=dtype)
    image, other = picture(1, 64, 64, torch.float32), picture(2, 64, 64, torch.float32)
    target = Target.from_image(image, net, kind=kind)
    assert float(texture_loss(image, target)) == 0.0
    assert float(color_loss(image, target)) == 0.0
    assert float(texture_loss(other, target)) > 0.2
    # The same numbers each time.
    assert float(texture_loss(other, target)) == float(texture_loss(other, target))


@pytest.mark.parametrize("kind", KINDS)
def test_shifts_and_more_periods_count_at_the_border_only(tmp_path: Path, kind: Kind) -> None:
    net = small_net(tmp_path)
    differences = []
    for side in (64, 256):
        image = picture(1, side, side)  # periodic over 16 pixels
        images = (image, image.roll((4, 8), (2, 3)), picture(1, side, 3 * side), picture(2, side, side))
        own, *others = (texture_statistics(x, net, (1, 2), kind) for x in images)
        differences.append([sum(float((a - b).abs().mean()) for a, b in zip(own, s, strict=True)) for s in others])
    (small_shift, small_wide, _), (shift, wide, unlike) = differences
    # The network sees zeros beyond the border, whose share falls as one over the side, 64 / 256.
    assert shift == pytest.approx(small_shift / 4, rel=0.2) and shift < 0.25 * unlike
    assert wide == pytest.approx(small_wide / 4, rel=0.2) and wide < 0.25 * unlike


@pytest.mark.parametrize("kind", KINDS)
def test_the_direction_of_a_twill_counts(kind: Kind) -> None:
    y, x = np.mgrid[:64, :64]
    twill = torch.tensor(0.5 + 0.4 * np.sin(2 * np.pi * (x + y) / 16), dtype=torch.float32).expand(1, 3, 64, 64)
    target = Target.from_image(twill, load_features(), (1, 2), kind)
    mirrored = float(texture_loss(twill.flip(3), target))
    shifted = float(texture_loss(twill.roll(5, 3), target))
    assert mirrored > 5.0 * shifted


def test_batches_are_averaged(tmp_path: Path) -> None:
    net = small_net(tmp_path)
    target = Target.from_image(picture(1), net, (1,))
    images = torch.cat([picture(2), picture(3)])
    single = [float(texture_loss(image, target)) for image in images]
    assert float(texture_loss(images, target)) == pytest.approx(np.mean(single), rel=1e-12)
    assert len(texture_statistics(images, net, (1, 2), "covariance")) == 8


def test_a_plain_surface_gives_finite_losses(tmp_path: Path) -> None:
    net = small_net(tmp_path)
    for kind in KINDS:
        for level in (0.0, 0.3):
            target = Target.from_image(torch.full((1, 3, 16, 16), level, dtype=torch.float64), net, (1, 2, 8), kind)
            assert torch.isfinite(texture_loss(picture(1, 16, 16), target))


def test_reduction_averages_linear_light_and_drops_the_rest() -> None:
    image = torch.arange(3 * 5 * 7, dtype=torch.float64).reshape(1, 3, 5, 7)
    expected = image[..., :4, :6].reshape(1, 3, 2, 2, 3, 2).mean(dim=(3, 5))
    torch.testing.assert_close(reduced(image, 2), expected)
    assert reduced(image, 1) is image


def test_light_above_one_counts_little_but_has_a_gradient() -> None:
    light = torch.tensor([0.0, 0.5, 1.0, 1.5, 100.0], dtype=torch.float64, requires_grad=True)
    rolled = rolled_off(light)
    (slope,) = torch.autograd.grad(rolled.sum(), light)
    np.testing.assert_array_equal(rolled[:3].detach(), light[:3].detach())
    assert 1.0 < rolled[3] < 1.05 and rolled[4] < 1.5
    assert (slope > 0).all()


def test_the_colour_loss_by_hand(tmp_path: Path) -> None:
    target = Target.from_image(torch.full((3, 16, 16), 0.5, dtype=torch.float64), small_net(tmp_path), (1,))
    render = torch.tensor([0.6, 0.5, 0.3], dtype=torch.float64).view(3, 1, 1).expand(3, 8, 8)
    assert float(color_loss(render, target)) == pytest.approx((0.1 + 0.0 + 0.2) / 3 / 0.5)


def test_the_roughness_prior_is_minus_the_log_of_the_papers_gaussian() -> None:
    roughness = torch.tensor([[0.25, 0.3, 0.17], [0.1, 0.9, 0.02]], dtype=torch.float64)
    density = np.exp(-((0.25 - 0.1) ** 2) / (2 * 0.15**2) - (0.17 - 0.02) ** 2 / (2 * 0.15**2))
    assert float(roughness_prior("satin", roughness[0])) == pytest.approx(-np.log(density))
    assert float(roughness_prior("satin", roughness)) == pytest.approx(
        -np.log(density) / 2
    )  # the second is at its mean
    for weave in ("plain", "twill", "basket", "other"):
        assert 0.0 < float(roughness_prior(weave, roughness)) < 0.02
    bad = roughness.clone()
    bad[0, 0] = torch.nan
    with pytest.raises(UsdfabError, match="not finite"):
        roughness_prior("satin", bad)


def test_bad_images(tmp_path: Path) -> None:
    net = load_features()
    small, fine = torch.full((3, 63, 200), 0.5), torch.full((3, 64, 64), 0.5)
    with pytest.raises(UsdfabError, match=r"the target has 200 x 63 pixels.*64 x 64 are needed"):
        Target.from_image(small, net)
    target = Target.from_image(fine, net, pixels_per_meter=1e5)
    with pytest.raises(UsdfabError, match="the render has 200 x 63 pixels"):
        texture_loss(small, target)
    for value in (torch.nan, torch.inf):
        spoiled = fine.clone()
        spoiled[1, 3, 4] = value
        with pytest.raises(UsdfabError, match="the target holds numbers that are not finite"):
            Target.from_image(spoiled, net)
        with pytest.raises(UsdfabError, match="the render holds numbers that are not finite"):
            texture_loss(spoiled, target)
    with pytest.raises(UsdfabError, match="no RGB image"):
        texture_loss(fine[:2], target)
    with pytest.raises(UsdfabError, match="same scale"):
        texture_loss(fine, target, pixels_per_meter=1.2e5)
    assert float(texture_loss(fine, target, pixels_per_meter=1.004e5)) == 0.0
    with pytest.raises(UsdfabError, match="no levels"):
        Target.from_image(fine, net, ())
    with pytest.raises(UsdfabError, match="no kind"):
        Target.from_image(fine, net, kind="fourier")  # type: ignore[arg-type]
    with pytest.raises(UsdfabError, match="2 images"):
        Target.from_image(torch.stack([fine, fine]), net)
