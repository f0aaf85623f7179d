"""Stage 3: what it finds in pictures whose answer is known, and what it does when things go wrong."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from path_pictures import SIDE, Stripes, cloth
from small_network import small_net

from usdfab.errors import UsdfabError
from usdfab.fabric.optics import optics_of, with_optics
from usdfab.fit import path_photo, path_stage
from usdfab.fit.features import FeatureNet
from usdfab.fit.path_loss import PathLoss, Weights
from usdfab.fit.path_noise import Denoised, Photographed, Spread, spread
from usdfab.fit.path_passes import RecycledPasses, SeparatePasses
from usdfab.fit.path_settings import PathSettings, settings_for
from usdfab.fit.path_space import OpticsSpace
from usdfab.fit.path_stage import refine_appearance, start_from_joint
from usdfab.imaging.lens import through_lens
from usdfab.usd.rig import swatch_scene

TRUTH = cloth()
START = cloth((0.5, 0.36, 0.26), (0.26, 0.42, 0.5), roughness_longitudinal=0.4)
SMALL = PathSettings(
    side=SIDE,
    iterations=8,
    spp=16,
    gradient_spp=16,
    levels=(1, 2),
    gain=False,
    noise="match",
    weights=Weights(anchor=0.0),
)
ADAM = replace(SMALL, steps="adam", passes="separate", iterations=40, rate=0.05)


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> FeatureNet:
    import torch

    return small_net(tmp_path_factory.mktemp("net"), dtype=torch.float32)


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    return Stripes(TRUTH).exact(optics_of(TRUTH).vector())[0]


def refined(photo, net, settings=SMALL, noise=0.0, broken=(), **more):
    return refine_appearance(
        START, photo, settings=settings, net=net, renderer=Stripes(START, noise, broken=broken), **more
    )


def errors(fabric) -> np.ndarray:
    """Of the albedos and of gamma_M, which is what the stripes depend on."""
    return abs(optics_of(fabric).vector() - optics_of(TRUTH).vector())[[0, 1, 2, 3, 4, 5, 6, 9]]


# --- what it finds ---


@pytest.mark.parametrize("settings", [SMALL, ADAM], ids=["model", "adam"])
def test_known_optics_are_found(settings, photo, net) -> None:
    before = errors(START)
    result = refined(photo, net, settings)
    assert errors(result.fabric).max() < 0.03 < before.max()
    assert result.losses.shape == (settings.iterations, 4) and result.history.shape == (settings.iterations, 14)
    assert result.losses[-1, 0] < 0.1 * result.losses[0, 0]
    # Geometry, and what stage 3 does not estimate, are as they were.
    assert with_optics(result.fabric, optics_of(START)) == START
    assert optics_of(result.fabric).ior.tolist() == optics_of(START).ior.tolist()
    assert result.gain == 1.0 and set(result.summary()["optics"]) == set(result.names)


def test_what_the_picture_does_not_show_stays(photo, net) -> None:
    """gamma_N and gamma_M0 change nothing in stripes; their uncertainty is their whole range, that of albedo small."""
    result = refined(photo, net, replace(SMALL, weights=Weights()), noise=0.3)
    unseen = [7, 8, 10, 11]
    start = optics_of(START).vector()
    np.testing.assert_allclose(optics_of(result.fabric).vector()[unseen], start[unseen], atol=0.005)
    assert result.uncertainty.shape == (14,) and (result.uncertainty[12:] == 0.0).all()
    assert result.uncertainty[unseen].min() > 3.0 * result.uncertainty[:6].max() > 0.0
    assert np.isnan(refined(photo, net, replace(ADAM, iterations=2)).uncertainty[:12]).all()


@pytest.mark.parametrize("settings", [replace(SMALL, iterations=16), ADAM], ids=["model", "adam"])
def test_with_noise_albedo_comes_back(settings, photo, net) -> None:
    result = refined(photo, net, settings, noise=0.6)
    assert errors(result.fabric)[:6].mean() < 0.02 < errors(START)[:6].mean()


def test_the_gain_is_found_where_the_light_is_brighter(photo, net) -> None:
    # Albedos count squared, so the fibers could be brighter as well: the prior on the gain keeps it below 1.2.
    result = refined(1.2 * photo, net, replace(SMALL, gain=True, iterations=12))
    assert 1.0 < result.gain < 1.25
    optics = optics_of(result.fabric).albedo.ravel()
    np.testing.assert_allclose(result.gain * optics**2, 1.2 * optics_of(TRUTH).albedo.ravel() ** 2, rtol=0.1)


def test_matched_noise_pulls_less_than_ignored_noise(photo, net) -> None:
    """Where is the loss of noisy pictures least? Noise looks like contrast, so ignoring it makes gamma_M too small."""
    vector = optics_of(TRUTH).vector()
    widths = np.linspace(0.3, 0.7, 9)
    plain = PathLoss(path_photo.photo_target(photo, net, (1, 2)), "plain")
    total = {"match": np.zeros(len(widths)), "ignore": np.zeros(len(widths))}
    for seed in range(6):
        rng = np.random.default_rng(seed)
        a, b = 0.8 * rng.standard_normal((2, SIDE, SIDE, 1))
        for i, width in enumerate(widths):
            vector[[6, 9]] = width
            exact = Stripes(TRUTH).exact(vector)[0]
            image, noise = exact * (1.0 + 0.5 * (a + b)), exact * 0.5 * (a - b)
            rough = vector[6:12].reshape(2, 3)
            total["ignore"][i] += plain(image, 0.0, rough).terms["texture"]
            total["match"][i] += plain.matched(photo, noise)(image, 0.0, rough).terms["texture"]
    best = {how: widths[np.argmin(values)] for how, values in total.items()}
    assert abs(best["match"] - 0.5) <= 0.051 and abs(best["ignore"] - 0.5) >= 0.09


# --- passes ---


def test_recycled_passes_are_the_picture_at_other_optics(photo) -> None:
    """Without noise: the derivatives move the means along; with noise: the mean of many has less of it."""
    vector = optics_of(TRUTH).vector()
    other = vector + 0.01
    passes = RecycledPasses(Stripes(TRUTH), SMALL)
    passes.picture(vector, 0)
    exact, _ = Stripes(TRUTH).exact(other)
    np.testing.assert_allclose(passes.picture(other, 1).image, exact, atol=2e-4)
    adjoint = np.random.default_rng(0).standard_normal(exact.shape)
    np.testing.assert_allclose(passes.gradient(adjoint), np.tensordot(passes.jacobian, adjoint, axes=3))
    noisy = RecycledPasses(Stripes(TRUTH, noise=1.0), SMALL)
    seen = [noisy.picture(vector, k) for k in range(40)]
    rms = [np.sqrt(np.mean((s.image - photo) ** 2)) for s in seen]
    assert rms[-1] < 0.35 * rms[0]
    # The sample of noise is as large as the noise, at the start and after many passes.
    for picture, size in ((seen[0], rms[0]), (seen[-1], rms[-1])):
        assert np.sqrt(np.mean(picture.noise**2)) == pytest.approx(size, rel=0.15)
        assert abs(np.mean(picture.noise * (picture.image - photo))) < 0.1 * size**2


def test_separate_passes_have_independent_seeds() -> None:
    vector = optics_of(TRUTH).vector()
    seeds: list[int] = []

    class Counting(Stripes):
        def _grain(self, spp, seed):
            seeds.append(seed)
            return super()._grain(spp, seed)

    passes = SeparatePasses(Counting(TRUTH, 1.0), SMALL)
    for iteration in range(5):
        passes.picture(vector, iteration)
        passes.gradient(np.ones((SIDE, SIDE, 3)))
    assert len(set(seeds)) == len(seeds) == 15


# --- coordinates and noise ---


def test_coordinates_go_back_and_forth_with_the_right_slope() -> None:
    fabric = replace(TRUTH, warp=replace(TRUTH.warp, albedo=(1.0, 0.0, 0.5), roughness_azimuthal=0.8))
    space = OpticsSpace.around(optics_of(fabric))
    assert space.size == 12 and "warp.ior" not in space.names
    at = space.coordinates(space.start)
    inside = [2, 3, 4, 5, 6, 7, 8]
    np.testing.assert_allclose(space.vector(at)[inside], space.start[inside], rtol=1e-12)
    assert 0.99 < space.vector(at)[0] < 0.999 and 0.0 < space.vector(at)[1] < 0.01
    step = 1e-6
    for i in range(space.size):
        shift = np.eye(space.size)[i] * step
        difference = (space.vector(at + shift) - space.vector(at - shift))[space.free[i]] / (2 * step)
        assert space.slope(at)[i] == pytest.approx(difference, rel=1e-5)
    for far in (-50.0, 50.0):  # never out of range
        with_optics(fabric, optics_of(fabric).with_vector(space.vector(np.full(space.size, far))))


@pytest.mark.parametrize("kind", ["spread", "denoised"])
def test_cleaning_keeps_the_light_and_has_the_right_transpose(kind, photo) -> None:
    rng = np.random.default_rng(3)
    noisy = photo * rng.lognormal(-0.5, 1.0, photo.shape)
    noisy[5, 7] = 40.0
    cleaned = Spread.of(noisy) if kind == "spread" else Denoised.of(noisy, lambda image: 0.8 * image)
    np.testing.assert_allclose(cleaned.image.mean(axis=(0, 1)), noisy.mean(axis=(0, 1)), rtol=1e-9)
    assert cleaned.image.max() < 5.0
    a, b = rng.standard_normal((2, *photo.shape))
    assert np.vdot(cleaned.derivatives(a[None])[0], b) == pytest.approx(np.vdot(a, cleaned.transposed(b)), rel=1e-9)
    if isinstance(cleaned, Spread):
        assert spread(a, cleaned.kept).sum() == pytest.approx(a.sum(), abs=1e-9)
        calm = np.full((8, 8, 3), 0.5)
        np.testing.assert_array_equal(Spread.of(calm).image, calm)


@pytest.mark.parametrize("blur", [1.1, -0.8])
def test_a_photo_through_a_lens(blur, photo, net) -> None:
    """The camera's blur goes with pictures and derivatives, so the optics come back; left out, they do not."""
    a, b = np.random.default_rng(4).standard_normal((2, *photo.shape))
    seen = Photographed(Spread.of(photo), blur)
    assert np.vdot(seen.derivatives(a[None])[0], b) == pytest.approx(np.vdot(a, seen.transposed(b)), rel=1e-9)
    blurred = through_lens(photo, blur)
    for settings in (SMALL, ADAM):
        result = refined(blurred, net, settings, blur=blur)
        assert errors(result.fabric).max() < 0.03
        assert errors(refined(blurred, net, settings).fabric).max() > 2.0 * errors(result.fabric).max()


# --- interruptions ---


@pytest.mark.parametrize("settings", [SMALL, replace(ADAM, iterations=8)], ids=["model", "adam"])
def test_resumed_is_the_same_bit_for_bit(settings, photo, net, tmp_path, monkeypatch) -> None:
    whole = refined(photo, net, settings, noise=0.5)
    file = tmp_path / "path.npz"

    def stop(done: int, of: int, loss: float) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refined(photo, net, settings, noise=0.5, checkpoint=file, progress=stop)
    seen: list[int] = []
    again = refined(photo, net, settings, noise=0.5, checkpoint=file, progress=lambda done, *_: seen.append(done))
    assert seen == list(range(3, settings.iterations + 1))[1:] or seen == list(range(3, settings.iterations + 1))
    assert again.fabric == whole.fabric and again.gain == whole.gain
    np.testing.assert_array_equal(again.losses, whole.losses)
    np.testing.assert_array_equal(again.history, whole.history)
    # A finished one gives its result at once.
    monkeypatch.setattr(path_stage, "_step", lambda *_: pytest.fail("nothing is left to do"))
    assert refined(photo, net, settings, noise=0.5, checkpoint=file).fabric == whole.fabric
    assert [p.name for p in tmp_path.iterdir()] == ["path.npz"]


def test_killed_while_it_works(photo, net, tmp_path) -> None:
    whole = refined(photo, net, noise=0.5)
    script = textwrap.dedent("""
        import os, signal, sys
        sys.path.insert(0, sys.argv[1])
        from pathlib import Path
        import torch
        import usdfab.fit.path_stage as stage
        from small_network import small_net
        from test_path_stage import SMALL, START, TRUTH, Stripes, optics_of

        stage.SAVE_SECONDS = 0.0
        folder = Path(sys.argv[2])
        photo = Stripes(TRUTH).exact(optics_of(TRUTH).vector())[0]
        def kill(done, of, loss):
            if done == 5:
                os.kill(os.getpid(), signal.SIGKILL)
        stage.refine_appearance(
            START, photo, settings=SMALL, net=small_net(folder, dtype=torch.float32),
            renderer=Stripes(START, 0.5), checkpoint=folder / "path.npz", progress=kill)
    """)
    command = [sys.executable, "-c", script, str(Path(__file__).parent), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, check=False, env=os.environ)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    seen: list[int] = []
    again = refined(
        photo, net, noise=0.5, checkpoint=tmp_path / "path.npz", progress=lambda done, *_: seen.append(done)
    )
    assert seen[0] == 5 and again.fabric == whole.fabric
    np.testing.assert_array_equal(again.losses, whole.losses)


def test_a_checkpoint_of_another_run(photo, net, tmp_path) -> None:
    file = tmp_path / "path.npz"
    short = replace(SMALL, iterations=1)
    refined(photo, net, short, checkpoint=file)
    with pytest.raises(UsdfabError, match="another photo"):
        refined(0.9 * photo, net, short, checkpoint=file)
    with pytest.raises(UsdfabError, match="another photo"):
        refined(photo, net, SMALL, checkpoint=file)
    whole = file.read_bytes()
    for damaged in (b"", whole[:100], b"PK\x03\x04" + whole[:50], whole[:-40]):
        file.write_bytes(damaged)
        with pytest.raises(UsdfabError, match=r"path.npz: (this is no unfinished stage|cannot be read)"):
            refined(photo, net, short, checkpoint=file)


# --- no numbers, wrong input ---


@pytest.mark.parametrize("settings", [SMALL, replace(ADAM, iterations=8)], ids=["model", "adam"])
def test_an_iteration_without_numbers_is_forgotten(settings, photo, net) -> None:
    result = refined(photo, net, settings, broken={5, 6})
    failed = np.isnan(result.losses).all(axis=1)
    assert 1 <= failed.sum() <= 2 and np.isfinite(result.losses[~failed]).all()
    assert result.summary()["failed_iterations"] == failed.sum()
    assert np.isfinite(result.history).all() and np.nanmin(result.losses[:, 0]) < 0.9 * result.losses[0, 0]


def test_nothing_but_no_numbers(photo, net) -> None:
    with pytest.raises(UsdfabError, match="iteration 5: 5 iterations in a row"):
        refined(photo, net, broken=range(1, 1000))


def test_photos_that_do_not_fit(photo, net) -> None:
    for wrong, words in (
        (photo[..., 0], "expected a picture"),
        (photo[:, :20], "aspect"),
        (np.where(photo > 0.1, np.nan, photo), "not finite"),
        (photo[:1, :1], "too few"),
    ):
        with pytest.raises(UsdfabError, match=words):
            refined(wrong, net)


def test_a_larger_photo_is_reduced_and_the_levels_are_those_that_fit(photo, net) -> None:
    camera = swatch_scene(START).cameras[0]
    large = np.kron(photo, np.ones((3, 3, 1)))
    assert path_photo.picture_size(large, camera, SMALL) == (SIDE, SIDE)
    assert path_photo.picture_size(photo[:16, :16], camera, SMALL) == (16, 16)
    np.testing.assert_allclose(path_photo.reduced_photo(large, (SIDE, SIDE)), photo, atol=1e-6)
    assert path_photo.photo_target(photo, net, (1, 2, 64)).levels == (1, 2)


def test_settings_out_of_range() -> None:
    for changes, words in (
        ({"side": 4}, "side"),
        ({"iterations": 0}, "iterations"),
        ({"spp": 0}, "spp"),
        ({"rate": 0.0}, "rate"),
        ({"trust": -1.0}, "trust"),
        ({"noise": "loud"}, "noise"),
        ({"steps": "model", "passes": "separate"}, "recycled"),
        ({"backend": "mitsuba", "passes": "recycled", "steps": "adam"}, "backend"),
    ):
        with pytest.raises(UsdfabError, match=words):
            settings_for("draft", **changes)
    with pytest.raises(UsdfabError, match="choose draft"):
        settings_for("best")  # type: ignore[arg-type]
    assert settings_for("paper").spp == 1024 and settings_for("standard", backend="mitsuba").steps == "adam"


def test_the_start_is_between_albedo_and_diffuse() -> None:
    diffuse = np.full((2, 3), 0.8)
    start = start_from_joint(TRUTH, diffuse)
    np.testing.assert_allclose(optics_of(start).albedo, 0.5 * (optics_of(TRUTH).albedo + 0.8))
    assert start.warp.roughness_longitudinal == TRUTH.warp.roughness_longitudinal
