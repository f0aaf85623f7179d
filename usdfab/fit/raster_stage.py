"""Stage 2: geometry and appearance together, by differentiable rasterization (Li et al. 2024, section 5.4 and 7.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fabric.optics import optics_of
from usdfab.fit.descent import Progress, State, descend, first_state, load_state
from usdfab.fit.features import FeatureNet, fast_dtype, load_features
from usdfab.fit.losses import roughness_prior
from usdfab.fit.match_pictures import MatchPictures
from usdfab.fit.newton import gauss_newton
from usdfab.fit.raster.curves import Shapes
from usdfab.fit.raster.multiple import DiffuseMap
from usdfab.fit.raster.renderer import RasterRenderer, RasterSettings, raster_renderer
from usdfab.fit.raster.shade import Look
from usdfab.fit.raster.shade_kernel import UNSHADOWED
from usdfab.fit.raster.unconstrained import FREE_NAMES, Parameters, parameters_of
from usdfab.fit.raster_multiple import measured_diffuse
from usdfab.fit.straighten import straightened as straightened
from usdfab.fit.texture import (
    DEFAULT_KIND,
    LEVELS,
    Kind,
    Target,
    color_loss,
    residual_weights,
    residuals,
    texture_loss,
)
from usdfab.imaging.lens import through_lens_torch
from usdfab.tracer.checkpoint import fingerprint
from usdfab.usd.rig import Rig, blur_in_pixels, sample_scene

Floats = NDArray[np.float64]
Quality = Literal["draft", "standard", "paper"]

Steps = Literal["newton", "adam"]

PRIOR_UNIT = 0.005
"""Of the loss: twice what one standard deviation from a prior costs where steps are ``newton``. About what the loss
gains, for each number, by following the chance of another draw of the fibers, which alone costs some .15."""

SPREADS = {
    "gain": 0.075, "twist": 0.3, "roughness_longitudinal": 0.6, "roughness_azimuthal": 0.4, "roughness_primary": 0.5,
}  # fmt: skip
"""Standard deviations of the priors about the start in the space without bounds; 1 for what is not here, a quarter of
the range at its middle. Of twist and roughness, whose ranges are wide beside what cloth has, about a fifth of the width
in Table 4 of Li et al. 2024."""

START_DIFFUSE = (0.02, 0.9)
"""Range that k_d is given before the first iteration."""


@dataclass(frozen=True)
class StageSettings:
    """How stage 2 works.

    Parameters
    ----------
    width:
        Of the target and the render, pixels; the scale follows from the photo's physical width.
    supersampling:
        Squared pixels per pixel.
    steps:
        ``newton``: Gauss-Newton, see ``newton``; ``adam``: as the paper.
    iterations:
        Adam's steps, or rounds of Gauss-Newton, each of which takes a picture for each number (two where ``traced``).
    rate:
        Size of Adam's steps in the space without bounds (Li et al. 2024, 7.2). A number in the middle of its range
        moves by 0.25 % of the range in a step of 0.01, and at most by a fifth of it in 75 steps.
    tied:
        Whether k_d is the multiple scattering that follows from C, measured with the path tracer before the first
        iteration, see ``raster.multiple``, and as such stands in shadows, too; else it is found like the rest and
        shadowed like single scattering, as in the paper.
    traced:
        Paths per pixel of a path-traced, denoised picture of each round's start, whose losses count then: the raster
        pictures' statistics are moved by how far they lie from its, so that what rasterization leaves out does not
        displace the result, see ``newton``. 0 is without. Only for ``newton`` where k_d is ``tied``: else C is not that
        of path tracing.
    texture, color, prior:
        Weights of the losses (eq. 11: all 1); 0 leaves one out. ``prior`` is for satin only, see ``losses``; where
        steps are ``newton`` it also holds what the picture does not tell near its start, in units of ``PRIOR_UNIT``.
    free:
        What moves; the rest stays as it starts.
    single, diffuse:
        Which parts of the approximate model (eq. 10) shade.
    levels, kind:
        Of the texture statistics.
    """

    width: int = 360
    supersampling: int = 2
    steps: Steps = "adam"
    iterations: int = 75
    rate: float = 0.01
    tied: bool = False
    traced: int = 0
    texture: float = 1.0
    color: float = 1.0
    prior: float = 1.0
    free: tuple[str, ...] = FREE_NAMES
    single: bool = True
    diffuse: bool = True
    levels: tuple[int, ...] = LEVELS
    kind: Kind = DEFAULT_KIND


QUALITIES: dict[str, StageSettings] = {
    "draft": StageSettings(
        width=128, supersampling=2, steps="newton", iterations=2, tied=True, traced=32, levels=(1, 2, 4), kind="gram"
    ),
    "standard": StageSettings(steps="newton", iterations=3, tied=True, traced=16),
    "paper": StageSettings(width=720),
}
"""What ``--quality`` means here.

A draft's pictures are too small for the usual statistics: reduced by 8, 128 pixels leave 2 x 2 at conv4_1, whose
covariance in the photo is close to nothing, and differences divided by it drown all else.
"""


JUDGE = StageSettings(width=240, supersampling=1, levels=(1, 2, 4), kind="gram")
"""By which all results are judged, whatever their quality: scales from a fifth of a yarn to a few yarns."""


@dataclass(frozen=True, eq=False)
class StageResult:
    """What stage 2 found.

    Parameters
    ----------
    fabric:
        The best iterate: shapes, roughnesses, and as albedo the C of the approximate model.
    diffuse: (K, 3), gain
        k_d of every colour, rows as ``optics_of(fabric).albedo``; the exposure.
    losses:
        Of every iteration; NaN where a step was taken back.
    best_iteration, best_loss:
        Which iterate it is.
    render: (H, W, 3)
        The best iterate as the rasterizer shows it.
    interrupted:
        Whether Ctrl-C ended it early.
    notes:
        Sentences for people.
    """

    fabric: FabricParameters
    diffuse: Floats
    gain: float
    losses: tuple[float, ...]
    best_iteration: int
    best_loss: float
    render: NDArray[np.float32]
    interrupted: bool
    notes: tuple[str, ...]


def refine_by_raster(
    fabric: FabricParameters,
    target: NDArray,
    settings: StageSettings | None = None,
    *,
    net: FeatureNet | None = None,
    rig: Rig | None = None,
    diffuse: float | Floats | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> StageResult:
    """Move a fabric until its raster image looks like ``target``.

    Parameters
    ----------
    fabric:
        The start; its seed fixes the random draws, its size the picture's.
    target: (H, W, 3)
        Linear Rec. 709, straightened, at the scale of the render: ``settings.width`` pixels to ``fabric.size[0]``. Its
        size may differ from the render's.
    net:
        The feature network; the shipped one by default.
    rig:
        Camera and point lights, and how sharp the camera is; None is the paper's, which is sharp.
    diffuse:
        k_d to start from, a number or (K, 3); by default what gives the render the target's mean colour.
    checkpoint, resume:
        A file in which the state is kept every few iterations; with ``resume`` the work goes on from it if it is there,
        to the same result, bit for bit, as without the break.

    Raises
    ------
    UsdfabError
        For a start outside the ranges, a target too small for the levels, a checkpoint of another job.
    """
    settings = settings or StageSettings()
    net = net or load_features(dtype=fast_dtype())
    picture = torch.from_numpy(np.ascontiguousarray(target, dtype=np.float32)).permute(2, 0, 1)
    goal = Target.from_image(picture, net, settings.levels, settings.kind)
    renderer = _renderer(fabric, settings, rig)
    job = fingerprint(fabric, np.asarray(target), np.asarray(diffuse), replace(settings, iterations=0), rig)
    tie = measured_diffuse(fabric, renderer, rig) if _diffuse_is_tied(settings) else None
    if diffuse is None:
        diffuse = matching_diffuse(renderer, np.asarray(target).mean(axis=(0, 1)))
    parameters = parameters_of(fabric, diffuse, free=_moving(settings, tie is not None))
    if resume and checkpoint is not None and checkpoint.exists():
        state = load_state(checkpoint, job)
    else:
        state = first_state(parameters.vector())
    picture_of = _Pictures(renderer, parameters, tie, blur_in_pixels(rig, settings.width / fabric.size[0]))
    if settings.steps == "adam":
        state, interrupted = descend(
            _loss(picture_of, goal, settings), state, settings.iterations, settings.rate, parameters.free_names,
            checkpoint=checkpoint, job=job, progress=progress,
        )  # fmt: skip
    else:
        state, interrupted = gauss_newton(
            _residuals(picture_of, goal), residual_weights(goal, settings.texture, settings.color),
            _prior(parameters, settings), state, settings.iterations, parameters.free_names,
            exact=_traced(picture_of, goal, settings, rig) if settings.traced and tie is not None else None,
            checkpoint=checkpoint, job=job, progress=progress,
        )  # fmt: skip
    return _result(picture_of, state, interrupted)


def _diffuse_is_tied(settings: StageSettings) -> bool:
    """Whether the diffuse term stands for multiple scattering; alone, it stands for all light."""
    return settings.tied and settings.single and settings.diffuse


def _moving(settings: StageSettings, tied: bool) -> tuple[str, ...]:
    without = {"diffuse"} if tied or not settings.diffuse else set()
    if not settings.single:
        without |= {"albedo", "roughness_longitudinal", "roughness_azimuthal", "roughness_primary"}
    return tuple(name for name in settings.free if name not in without)


def render_size(fabric: FabricParameters, width: int) -> tuple[int, int]:
    """(width, height) of a picture of the whole fabric."""
    return width, max(1, round(width * fabric.size[1] / fabric.size[0]))


def _renderer(fabric: FabricParameters, settings: StageSettings, rig: Rig | None = None) -> RasterRenderer:
    size = render_size(fabric, settings.width)
    raster = RasterSettings(
        size, settings.supersampling, single=settings.single, diffuse=settings.diffuse, rims=settings.steps == "adam",
        unshadowed=UNSHADOWED if _diffuse_is_tied(settings) else 0.0,
    )  # fmt: skip
    return raster_renderer(sample_scene(fabric, rig), raster)


@dataclass(frozen=True, eq=False)
class _Pictures:
    """Pictures of a vector without bounds; ``tie`` gives k_d where C does, ``blur`` is the camera's in pixels."""

    renderer: RasterRenderer
    parameters: Parameters
    tie: DiffuseMap | None
    blur: float = 0.0

    def look(self, vector: torch.Tensor) -> tuple[Shapes, Look]:
        shapes, look = self.parameters.of(self.parameters.natural(vector))
        return shapes, look if self.tie is None else replace(look, diffuse=self.tie(look.albedo))

    def __call__(self, vector: torch.Tensor) -> tuple[torch.Tensor, Look]:
        """(3, H, W), and what it shows."""
        shapes, look = self.look(vector)
        return through_lens_torch(self.renderer.image(shapes, look).permute(2, 0, 1), self.blur), look


def _loss(picture_of: _Pictures, goal: Target, settings: StageSettings) -> Callable[[torch.Tensor], torch.Tensor]:
    weave_class = picture_of.parameters.fabric.weave.classify()

    def loss(vector: torch.Tensor) -> torch.Tensor:
        image, look = picture_of(vector)
        if not image.isfinite().all():
            # The losses refuse such a picture; to the descent it is a step too far.
            return (vector * torch.nan).sum()
        total = settings.texture * texture_loss(image, goal) if settings.texture else image.new_zeros(())
        if settings.color:
            total = total + settings.color * color_loss(image, goal)
        if settings.prior:
            total = total + settings.prior * roughness_prior(weave_class, look.roughness)
        return total

    return loss


def _residuals(picture_of: _Pictures, goal: Target) -> Callable[[torch.Tensor], torch.Tensor]:
    def found(vector: torch.Tensor) -> torch.Tensor:
        image, _ = picture_of(vector)
        return residuals(image, goal) if image.isfinite().all() else image.new_full((1,), torch.nan)

    return found


def _traced(
    picture_of: _Pictures, goal: Target, settings: StageSettings, rig: Rig | None
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Residuals of the path-traced picture of a vector, at the exposure that it says, through the rig's camera."""
    traced = MatchPictures(goal, settings.width, settings.traced, seed=0)

    def found(vector: torch.Tensor) -> torch.Tensor:
        parameters = picture_of.parameters
        natural = parameters.natural(vector)
        picture = traced.sketch(parameters.fabric_of(natural), rig)
        gain = float(parameters.of(natural)[1].gain)
        return torch.from_numpy(traced.residuals(picture, gain, picture_of.blur))

    return found


def _prior(parameters: Parameters, settings: StageSettings) -> Callable[[torch.Tensor], torch.Tensor]:
    """Of the start, and of the weave's roughnesses."""
    start = parameters.vector()
    kinds = [name.split(".")[-1].split("[")[0] for name in parameters.free_names]
    spread = torch.tensor([SPREADS.get(kind, 1.0) for kind in kinds], dtype=torch.float64)
    weave_class = parameters.fabric.weave.classify()

    def prior(vector: torch.Tensor) -> torch.Tensor:
        _, look = parameters.of(parameters.natural(vector))
        about = 0.5 * ((vector - start) / spread).square().sum()
        return PRIOR_UNIT * settings.prior * (about + roughness_prior(weave_class, look.roughness))

    return prior


def _result(picture_of: _Pictures, state: State, interrupted: bool) -> StageResult:
    with torch.no_grad():
        image, look = picture_of(state.best)
        render = np.ascontiguousarray(image.permute(1, 2, 0).float().numpy())
    return StageResult(
        picture_of.parameters.fabric_of(picture_of.parameters.natural(state.best)),
        look.diffuse.numpy().copy(),
        float(look.gain),
        state.losses,
        state.best_iteration,
        state.best_loss,
        render,
        interrupted,
        state.notes,
    )


def matching_diffuse(renderer: RasterRenderer, mean: Floats) -> Floats:
    """k_d (K, 3), in proportion to the albedo, with which the fabric's raster image has the colour ``mean`` (3,)."""
    albedo = optics_of(renderer.fabric).albedo
    shapes = renderer.model.shapes()
    with torch.no_grad():
        dark, bright = (
            renderer.image(shapes, renderer.look_of(k_d)).double().mean(dim=(0, 1)).numpy()
            for k_d in (np.zeros_like(albedo), albedo)
        )
    factor = (np.asarray(mean, dtype=np.float64) - dark) / np.maximum(bright - dark, 1e-9)
    return np.clip(factor * albedo, *START_DIFFUSE)


def checked_quality(quality: str) -> StageSettings:
    """The settings of a ``--quality``."""
    if quality not in QUALITIES:
        raise UsdfabError(f"there is no quality '{quality}'", place="--quality", remedy=f"use {', '.join(QUALITIES)}")
    return QUALITIES[quality]


__all__: Sequence[str] = (
    "QUALITIES",
    "StageResult",
    "StageSettings",
    "checked_quality",
    "matching_diffuse",
    "refine_by_raster",
    "render_size",
    "straightened",
)
