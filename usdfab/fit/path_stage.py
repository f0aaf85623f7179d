"""Stage 3 of the fit: colours and roughnesses refined by differentiable path tracing (Li et al. 2024, 5.5, 7.3).

    result = refine_appearance(fabric, photo, settings=settings_for("standard"), checkpoint="path.npz")
    better = result.fabric

The geometry is frozen. Adam changes the optics until the render's texture and colour are the photo's. What the paper
leaves open is settled here: `path_space` keeps parameters in their ranges, `path_passes` says where pictures and
derivatives come from, `path_noise` what is done about noise.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.optics import Optics, optics_of, with_optics
from usdfab.fit.features import FeatureNet, fast_dtype, load_features
from usdfab.fit.path_checkpoint import State, load_state, save_state
from usdfab.fit.path_loss import PathLoss
from usdfab.fit.path_noise import Cleaned, Denoised, Photographed, Spread, spread
from usdfab.fit.path_passes import Picture, RecycledPasses, Renderer, SeparatePasses, make_renderer
from usdfab.fit.path_photo import photo_target, picture_size, reduced_photo
from usdfab.fit.path_result import PathResult, chosen_point, uncertainty_of
from usdfab.fit.path_settings import PathSettings
from usdfab.fit.path_space import OpticsSpace
from usdfab.fit.path_steps import adam_step, anchor_loss, gradient_by_point, model_step
from usdfab.imaging.denoise import check_denoiser, denoise
from usdfab.imaging.lens import through_lens
from usdfab.tracer.checkpoint import fingerprint
from usdfab.usd.rig import swatch_scene
from usdfab.usd.scene import Camera, Scene

Floats = NDArray[np.float64]

Progress = Callable[[int, int, float], None]
"""Called with (iterations done, iterations to do, loss)."""

MAX_FAILURES = 5
"""Iterations in a row without a usable picture, loss or gradient after which the stage gives up."""

SAVE_SECONDS = 5.0


def start_from_joint(fabric: FabricParameters, diffuse: ArrayLike) -> FabricParameters:
    """``fabric`` with the albedos that stage 3 starts from: C0 = (C + k_d) / 2 (Li et al. 2024, 7.3).

    Parameters
    ----------
    fabric:
        Stage 2's result.
    diffuse: (K, 3)
        k_d of each colour of ``optics_of(fabric)``, or of all.
    """
    optics = optics_of(fabric)
    start = np.clip(0.5 * (optics.albedo + np.asarray(diffuse, dtype=np.float64)), 0.0, 1.0)
    return with_optics(fabric, Optics(start, optics.system, optics.roughness, optics.ior))


def refine_appearance(
    fabric: FabricParameters,
    photo: NDArray,
    *,
    scene: Scene | None = None,
    camera: Camera | None = None,
    blur: float = 0.0,
    settings: PathSettings | None = None,
    net: FeatureNet | None = None,
    renderer: Renderer | None = None,
    checkpoint: str | Path | None = None,
    progress: Progress | None = None,
    keep_interrupted: bool = False,
) -> PathResult:
    """Refine a fabric's colours and roughnesses until its render looks as the photo does.

    Parameters
    ----------
    fabric:
        Where to start; of the geometry and the weave nothing changes.
    photo: (H, W, 3)
        Linear Rec. 709, rows from the top, of exactly what the camera sees: ``fabric.size`` under the capture rig.
    scene:
        A rig with the fabric on it; by default ``swatch_scene(fabric)``.
    camera:
        By default the scene's first.
    blur:
        How sharp the photo is, in its own pixels: ``imaging.lens``.
    settings:
        By default those of the quality ``standard``.
    net:
        The feature network; by default ``settings.features``.
    renderer:
        By default that of ``settings.backend``; another must have the size of :func:`picture_size`.
    checkpoint:
        A file that the run is saved to now and then, and goes on from where it exists: to the same result, bit for
        bit, as without the interruption. It stays; a finished one gives its result at once.
    progress:
        Called after each iteration.
    keep_interrupted:
        After Ctrl-C, give the best so far, ``interrupted``, instead of raising ``KeyboardInterrupt``.

    Raises
    ------
    UsdfabError
        For a photo that is no picture, too small or of another aspect than the camera's, a checkpoint of another run,
        and after ``MAX_FAILURES`` iterations in a row that gave no numbers.
    """
    began = time.perf_counter()
    settings = settings or PathSettings()
    scene = scene or swatch_scene(fabric)
    camera = camera or scene.cameras[0]
    size = picture_size(photo, camera, settings)
    # Differences of statistics need all digits.
    dtype = torch.float32 if settings.steps == "model" else fast_dtype()
    net = net or load_features(settings.features, dtype=dtype)
    renderer = renderer or make_renderer(scene, camera, size, settings)
    settings, clean = _noise_treatment(renderer, settings)
    small = reduced_photo(photo, size)
    if settings.noise != "ignore":
        small = Spread.of(small).image  # what is done to the render's highlights is done to the photo's
    loss = PathLoss(photo_target(small, net, settings.levels), fabric.weave.classify(), settings.weights)
    space = OpticsSpace.around(renderer.optics)
    soft = blur * size[0] / photo.shape[1]
    passes: SeparatePasses | RecycledPasses = (
        RecycledPasses(renderer, settings)  # type: ignore[arg-type]
        if settings.passes == "recycled"
        else SeparatePasses(renderer, settings)
    )
    state = State.begin(np.append(space.coordinates(space.start), 0.0), settings.rate)
    file = None if checkpoint is None else Path(checkpoint)
    job = (scene, camera, blur, replace(settings, threads=None), np.asarray(photo))
    identity = "" if file is None else fingerprint(*job)
    if file is not None and file.exists():
        state, saved = load_state(file, identity)
        passes.restore(saved)
    before = state.iteration
    state = _optimise(
        state, space, passes, loss, clean, soft, small, settings, file, identity, progress, keep_interrupted
    )  # fmt: skip
    point, least = chosen_point(state)
    found = renderer.optics.with_vector(space.vector(point[:-1]))
    paths = 1e-6 * size[0] * size[1] * (settings.spp + settings.gradient_spp) * (state.iteration - before)
    return PathResult(
        with_optics(fabric, found),
        float(np.exp(point[-1])),
        state.losses,
        np.array([space.vector(row[:-1]) for row in state.history]),
        np.exp(state.history[:, -1]),
        renderer.optics.names(),
        uncertainty_of(state.curvature, point, least, space),
        least,
        paths,
        time.perf_counter() - began,
        state.iteration < settings.iterations,
    )


def _noise_treatment(renderer: Renderer, settings: PathSettings) -> tuple[PathSettings, Callable[[Picture], Cleaned]]:
    """The settings with ``auto`` replaced, and how pictures are made fit for the loss.

    Raises
    ------
    UsdfabError
        Where denoising is asked for and the denoiser is missing, or the renderer has no guides for it.
    """
    how = settings.noise
    if how == "auto":
        able = hasattr(renderer, "guides") and denoiser_installed()
        how = "denoise" if able else "match"
    settings = replace(settings, noise=how)
    if how == "ignore":
        return settings, lambda picture: Spread(picture.image, np.ones((*picture.image.shape[:2], 1)))
    if how == "match":
        return settings, lambda picture: Spread.of(picture.image)
    check_denoiser()
    if not hasattr(renderer, "guides"):
        raise UsdfabError("this renderer has no guides for the denoiser", place="noise", remedy="use match")
    albedo, normal = renderer.guides()
    return settings, lambda picture: Denoised.of(
        picture.image, lambda image: denoise(image, albedo, normal).astype(np.float64)
    )


def denoiser_installed() -> bool:
    """Whether pictures can be denoised here."""
    try:
        check_denoiser()
    except UsdfabError:
        return False
    return True


def _optimise(
    state: State,
    space: OpticsSpace,
    passes: SeparatePasses | RecycledPasses,
    loss: PathLoss,
    clean: Callable[[Picture], Cleaned],
    blur: float,
    photo: Floats,
    settings: PathSettings,
    file: Path | None,
    identity: str,
    progress: Progress | None,
    keep_interrupted: bool,
) -> State:
    """All iterations that are left. An interruption from the keyboard leaves a checkpoint of the last whole one."""
    saved, kept = time.perf_counter(), passes.state()
    try:
        while state.iteration < settings.iterations:
            state = _step(state, space, passes, loss, clean, blur, photo, settings)
            kept = passes.state()
            if progress:
                progress(state.iteration, settings.iterations, float(state.losses[-1, 0]))
            if file is not None and time.perf_counter() - saved > SAVE_SECONDS:
                save_state(file, identity, state, kept)
                saved = time.perf_counter()
    except KeyboardInterrupt:
        if not (keep_interrupted and np.isfinite(state.losses[:, 0]).any()):
            raise
    finally:
        if file is not None and state.iteration > 0:
            save_state(file, identity, state, kept)
    return state


def _step(
    state: State,
    space: OpticsSpace,
    passes: SeparatePasses | RecycledPasses,
    loss: PathLoss,
    clean: Callable[[Picture], Cleaned],
    blur: float,
    photo: Floats,
    settings: PathSettings,
) -> State:
    """One iteration; where it gives no numbers, back to the last point that did, with shorter steps."""
    point = state.coordinates
    vector = space.vector(point[:-1])
    picture = passes.picture(vector, state.iteration)
    value, change, gradient, normal = None, np.zeros(len(point)), np.zeros(len(point)), state.curvature
    if picture.finite:
        own = clean(picture)
        cleaned = Photographed(own, blur)
        if settings.noise == "match":
            scaled = np.exp(point[-1]) * picture.noise
            noise = spread(scaled, own.kept) if isinstance(own, Spread) else scaled
            loss = loss.matched(photo, through_lens(noise, blur))
        value = loss(cleaned.image, float(point[-1]), vector[-8:-2].reshape(2, 3))
        if value.finite and isinstance(passes, RecycledPasses) and settings.steps == "model":
            jacobian = cleaned.derivatives(passes.jacobian)
            trust = settings.trust * state.rate / settings.rate
            change, normal = model_step(cleaned.image, jacobian, point, space, loss, trust, settings.gain)
        elif value.finite:
            by_vector = passes.gradient(cleaned.transposed(value.adjoint))
            gradient = gradient_by_point(value, by_vector, space, point, loss, settings.gain)
    good = value is not None and value.finite and bool(np.isfinite(gradient).all() and np.isfinite(change).all())
    row = [np.nan] * 4
    if good and value:
        total = value.total + anchor_loss(point, space, loss)
        row = [total, *(value.terms[k] for k in ("texture", "color", "prior"))]
    done = replace(
        state,
        iteration=state.iteration + 1,
        losses=np.vstack([state.losses, row]),
        history=np.vstack([state.history, point]),
    )
    zero = np.zeros(len(point))
    if not good:
        failures = state.failures + 1
        if failures >= MAX_FAILURES:
            raise UsdfabError(
                f"{failures} iterations in a row gave no finite picture, loss or gradient",
                place=f"iteration {done.iteration}",
                remedy="start from other optics or give more samples",
            )
        return replace(
            done, failures=failures, rate=0.5 * state.rate, coordinates=state.best.copy(), first=zero, second=zero
        )
    first, second = state.first, state.second
    if settings.steps == "adam":
        # Bias correction counts the steps since the moments were zero, which a failure makes them.
        steps = 1 + len(state.losses) - _after_failure(state.losses)
        change, first, second = adam_step(gradient, first, second, steps, state.rate)
    return replace(
        done, failures=0, coordinates=point + change, first=first, second=second, best=point.copy(), curvature=normal
    )


def _after_failure(losses: Floats) -> int:
    failed = np.flatnonzero(~np.isfinite(losses[:, 0]))
    return int(failed[-1]) + 1 if len(failed) else 0
