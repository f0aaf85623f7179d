"""The match stage: shape, appearance, exposure and sharpness, until the texture of path-traced pictures is the photo's.

Everything that the tracer shows takes part: light that scatters many times, gaps, shadows between yarns, flyaways,
plies. Derivatives of the texture statistics are finite differences between denoised pictures of the same random draws,
one picture for each coordinate; what the photo is compared with is of another kind, which is not as smooth
(``match_pictures``). There are few coordinates and the statistics are smooth in them, so a few Gauss-Newton
steps do what gradient descent needs a hundred for; between two rounds of differences, derivatives are kept right by
what the steps themselves show (Broyden 1965). The statistics are those of Li et al. 2024, eq. 12.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters
from usdfab.fit.match_looks import Answers, Seen, best_answers, looks_at, most_looks, questions
from usdfab.fit.match_pictures import MatchPictures
from usdfab.fit.match_space import BLUR, CONTRAST, MOVES, OF_THE_CAMERA, MatchSpace, level_of
from usdfab.fit.match_steps import best_step, broyden_update, damped_step, normal_equations, soft_l1
from usdfab.fit.stage_file import load_stage, save_stage
from usdfab.tracer.checkpoint import fingerprint
from usdfab.usd.rig import Rig, blur_in_pixels, contrast_of, rig_for

if TYPE_CHECKING:
    from usdfab.fit.features import FeatureNet
    from usdfab.fit.texture import Kind

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

FORMAT = "usdfab-match/9"
LONGEST_STEP = 2.0
DAMPINGS = (0.01, 0.1, 1.0, 10.0)
"""Tried one after another until a step leads down; each iteration begins with the one that last did."""

LIGHT_STEP = 0.14
"""Between the exposures in which each first look is seen (of the logarithm), about that which makes it as bright as the
photo on the mean: what suited the looks before does not suit other lamps."""

CAMERA_STEPS = 3
"""Of the camera alone, at most, before each round."""

RAYS_PER_PATH = 20.0
"""Of cloth neither dark nor white, about."""

SPREAD_OF_FIT = 0.3
"""A change of the loss by this part of itself is one standard deviation: about what another crop of a photo makes."""


@dataclass(frozen=True)
class MatchSettings:
    """Settings of the stage.

    Parameters
    ----------
    width:
        Pixels along x of the pictures that are compared.
    spp:
        Samples per pixel of each picture, before the denoiser, and of what its radiance cache learns from; at least.
    rays:
        Rays a pixel that a picture may cost; where they pay for more samples than ``spp``, there are more. 0: never.
    later_scale:
        Least scale of fibers' azimuthal lobes after the first bounce, rad, in these pictures (``Tracer``): less noise,
        while the brightness stays within about 2 %.
    look_rays:
        The same for the first looks, which are many. 0: they cost what the others do.
    iterations:
        Rounds of finite differences.
    steps:
        Gauss-Newton steps at most after each round.
    levels, kind:
        Of the texture statistics, see ``texture.Target``.
    prior:
        Weight of the prior, see ``match_steps.damped_step``.
    free:
        Names of ``match_space.MOVES`` and ``OF_THE_CAMERA``; where the rig is known, its blur and contrast do not move.
    seed:
        Of the renders.
    """

    width: int = 240
    spp: int = 4
    rays: int = 0
    later_scale: float | None = None
    look_rays: int = 0
    iterations: int = 2
    steps: int = 3
    levels: tuple[int, ...] = (1, 2, 4)
    kind: Kind = "gram"
    prior: float = 0.004
    free: tuple[str, ...] = (*MOVES, *OF_THE_CAMERA)
    seed: int = 0

    @property
    def pictures(self) -> int:
        """How many pictures are rendered at most, about; looks that cost less count for less."""
        systems, channels = 2, 3
        moving = [name for name in self.free if name not in OF_THE_CAMERA]
        coordinates = systems * (len(moving) + (channels - 1 if "albedo" in moving else 0))
        looks = most_looks(questions(self.shapes, rig_known=False))
        if self.look_rays and self.rays:
            looks = round(looks * self.look_rays / self.rays)
        return looks + self.iterations * (1 + coordinates + self.steps * len(DAMPINGS))

    @property
    def samples(self) -> float:
        """Samples per pixel that cost what a picture costs, about, in cloth neither dark nor white."""
        return max(float(self.spp), self.rays / RAYS_PER_PATH)

    @property
    def shapes(self) -> bool:
        """Whether the shape of yarns is free, so that the first looks may change it."""
        return "radius" in self.free and "flattening" in self.free


DRAFTED = (
    "radius", "flattening", "crimp", "twist", "waviness", "irregularity", "flyaway_density", "albedo_variation",
    "roughness_azimuthal", "albedo",
    *OF_THE_CAMERA,
)  # fmt: skip
"""What a draft moves: what one round can settle, and is seen at its resolution."""

SOFTER = 0.15
"""``later_scale`` of all qualities."""

QUALITIES: dict[str, MatchSettings] = {
    "draft": MatchSettings(width=192, rays=100, look_rays=50, later_scale=SOFTER, iterations=1, free=DRAFTED),
    "standard": MatchSettings(rays=200, look_rays=100, later_scale=SOFTER),
    "paper": MatchSettings(width=360, spp=16, rays=500, look_rays=200, later_scale=SOFTER, iterations=4),
}
"""What ``--quality`` means here."""


@dataclass(frozen=True)
class MatchPoint:
    """A fabric, what its picture under ``rig`` is multiplied by to be as bright as the target, and the rig, whose blur
    is that of the photo."""

    fabric: FabricParameters
    exposure: float
    rig: Rig | None = None


@dataclass(frozen=True, eq=False)
class MatchResult:
    """What the stage found.

    Parameters
    ----------
    way:
        The points that were taken, from the best look on; the last has the least loss. Its pictures are few samples,
        denoised: seen better, an earlier one may be closer to the photo.
    losses:
        Of the start, after each step that was taken, and after the camera alone moved.
    uncertainty:
        Standard deviations by name in the parameters' own units: how far each may move, all others following, before
        the loss grows by ``SPREAD_OF_FIT`` of itself.
    interrupted:
        Whether Ctrl-C ended it early.
    """

    way: tuple[MatchPoint, ...]
    losses: tuple[float, ...]
    uncertainty: dict[str, float]
    interrupted: bool

    @property
    def fabric(self) -> FabricParameters:
        """Of the last point."""
        return self.way[-1].fabric

    @property
    def exposure(self) -> float:
        """Of the last point."""
        return self.way[-1].exposure

    @property
    def rig(self) -> Rig | None:
        """Of the last point."""
        return self.way[-1].rig


@dataclass(eq=False)
class _State:
    """Where the search stands after ``round`` rounds of differences; ``way`` are the points that were taken."""

    round: int
    point: Floats
    losses: list[float]
    way: list[Floats]
    answers: Answers = ()
    light: float = 1.0
    damping: int = 0
    deviations: Floats | None = None


@dataclass(frozen=True, eq=False)
class _Look:
    """Answers to the first questions, the light (a factor of the exposure) that suits them, and what is seen."""

    answers: Answers
    light: float
    picture: Singles
    residuals: Singles
    loss: float


@dataclass(frozen=True, eq=False)
class _Point:
    """Coordinates, and what is seen there."""

    place: Floats
    picture: Singles
    residuals: Singles
    loss: float


def match_photo(
    start: FabricParameters,
    goal: NDArray,
    settings: MatchSettings,
    *,
    net: FeatureNet,
    exposure: float = 1.0,
    rig: Rig | None = None,
    rig_known: bool = False,
    checkpoint: Path | None = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> MatchResult:
    """Move a fabric until its path-traced picture has the texture of ``goal``.

    Parameters
    ----------
    start:
        Where to begin, e.g. the analysis' fabric.
    goal: (H, W, 3)
        Linear, upright, ``settings.width / start.size[0]`` pixels per metre.
    net:
        See ``features.load_features``.
    exposure:
        What pictures are multiplied by at the start, see ``albedo.photo_exposure``.
    rig, rig_known:
        Camera and lamps at the start (None: the paper's), and whether these are the photo's or only a first guess.
    checkpoint:
        A file that keeps the state after each round; if it is there and belongs to the same run, the run goes on from
        it to the same result. It is left there at the end.
    progress:
        Called with (pictures rendered, pictures at most, loss).

    Raises
    ------
    UsdfabError
        If the denoiser is missing, the target too small, or the checkpoint damaged or of another run.
    """
    import torch

    from usdfab.fit.texture import Target

    picture = torch.from_numpy(np.ascontiguousarray(goal, dtype=np.float32)).permute(2, 0, 1)
    target = Target.from_image(picture, net, settings.levels, settings.kind)
    pictures = MatchPictures(target, settings.width, settings.spp, settings.seed, settings.later_scale)
    identity = fingerprint(start, np.asarray(goal, dtype=np.float32), settings, float(exposure), rig, rig_known)
    state = None
    if checkpoint is not None and checkpoint.exists():
        state = load_stage(checkpoint, FORMAT, identity, _state)
    search = _Search(Seen(start, rig), rig_known, exposure, pictures, settings, state, progress)
    space, state = search.space, search.state
    interrupted = False
    try:
        search.begin()
        space = search.space
        while state.round < settings.iterations:
            search.round()
            if checkpoint is not None:
                save_stage(checkpoint, FORMAT, identity, _arrays(state))
    except KeyboardInterrupt:
        interrupted = True
    deviations = state.deviations if state.deviations is not None else np.zeros(len(space.names))
    return MatchResult(
        tuple(MatchPoint(space.fabric(p), space.exposure(p), search.rig_at(p)) for p in state.way), tuple(state.losses),
        {k: v for k, v in space.deviations(state.point, deviations).items() if v > 0.0}, interrupted,
    )  # fmt: skip


class _Search:
    def __init__(
        self,
        start: Seen,
        rig_known: bool,
        exposure: float,
        pictures: MatchPictures,
        settings: MatchSettings,
        state: _State | None,
        progress: Callable[[int, int, float], None] | None,
    ) -> None:
        self.pictures, self.settings, self.fresh = pictures, settings, state is None
        self.start, self.rig = start, start.rig
        self.questions = questions(settings.shapes, rig_known)
        free = [name for name in settings.free if not (rig_known and name in (BLUR, CONTRAST))]
        blur, contrast = (start.rig.blur, start.rig.contrast) if start.rig else (0.0, 1.0)
        self.space = MatchSpace.about(start.fabric, free, exposure, blur, contrast, level_of(pictures.target))
        self.scale = settings.width / start.fabric.size[0]
        self.state = state or _State(0, np.zeros(len(self.space.names)), [], [np.zeros(len(self.space.names))])
        self._progress = progress or (lambda *_: None)
        self._each = 1 + len(self.space.names) + settings.steps * len(DAMPINGS)
        self._looks = most_looks(self.questions)
        self._done = self.state.round * self._each
        self.loss = math.inf
        self._lights: dict[Answers, int] = {}

    def begin(self) -> None:
        """Take the first looks, or go back to the point where the search stood."""
        state, exposure = self.state, self.space.light
        if not self.fresh:
            self._done += self._looks
            self._settle(exposure)
            return
        rays = self.settings.look_rays or self.settings.rays
        if rays:
            self.pictures.spend(rays, self.start.fabric, self.start.rig)
        looks: dict[Answers, _Look] = {}

        def loss_of(answers: Answers) -> float:
            looks[answers] = self._look_as(answers, exposure)
            return looks[answers].loss

        best = looks[best_answers(self.questions, loss_of)]
        state.losses.append(looks[()].loss)
        if best.loss < state.losses[0]:
            state.losses.append(best.loss)
        state.answers, state.light = best.answers, best.light
        self._settle(exposure)

    def _look_as(self, answers: Answers, exposure: float) -> _Look:
        """What is seen with some answers, in the light in which it comes closest; the start also in its own."""
        seen = looks_at(self.start, self.questions, answers)
        self._done += 1
        picture = self.pictures.picture(seen.fabric, seen.rig)
        mean = float(self.pictures.mean.mean()) / max(exposure * float(picture.mean()), 1e-6)
        blur, contrast = blur_in_pixels(seen.rig, self.scale), contrast_of(seen.rig)

        def look(light: float) -> _Look:
            residuals = self.pictures.residuals(picture, exposure * light, blur, contrast)
            return _Look(answers, light, picture, residuals, soft_l1(residuals, self.pictures.weights))

        # From what suited the look before this one.
        before = self._lights.get(answers[:-1], 0)
        best, self._lights[answers] = best_step(
            lambda step: look(mean * math.exp(LIGHT_STEP * step)), before, lambda look: look.loss
        )
        if not answers:
            best = min(best, look(1.0), key=lambda look: look.loss)
        self.loss = min(self.loss, best.loss)
        self._tell(self.loss)
        return best

    def _settle(self, exposure: float) -> None:
        """Go to the point where the search stands, from the looks that were found best."""
        seen = looks_at(self.start, self.questions, self.state.answers)
        blur = seen.rig.blur if seen.rig else 0.0
        self.space = replace(self.space, start=seen.fabric, light=exposure * self.state.light, blur=blur)
        self.rig = seen.rig
        if self.questions:
            # The best of many looks owes something to its noise, which steps would have to beat.
            self.pictures.seed = self.settings.seed + 1
        self.pictures.spp = self.pictures.cached_spp = self.pictures.learning = self.settings.spp
        if self.settings.rays:
            self.pictures.spend(self.settings.rays, seen.fabric, seen.rig)
        self.picture, self.residuals, self.loss = self._look(self.state.point)

    def rig_at(self, point: Floats) -> Rig | None:
        """Camera and lamps at a point; None is the paper's rig, which is sharp and linear."""
        blur, contrast = self.space.blur_at(point), self.space.contrast_at(point)
        if self.rig is None and (blur, contrast) == (0.0, 1.0):
            return None
        return replace(self.rig or rig_for(self.space.start.size), blur=blur, contrast=contrast)

    def round(self) -> None:
        """One round of finite differences, and the steps that follow from it."""
        state, settings = self.state, self.settings
        before = self._done
        self._settle_camera()
        jacobian, nearby = self._jacobian()
        for step in range(settings.steps):
            matrix, gradient = normal_equations(self.residuals, jacobian, self.pictures.weights)
            if not self._step(matrix, gradient, jacobian):
                # Where the quadratic misleads, one of the points that were looked at may still be a better one.
                if step == 0 and (nearby != state.point).any():
                    there = _Point(nearby, *self._look(nearby))
                    if there.loss < self.loss:
                        self._take(there)
                break
        matrix, _ = normal_equations(self.residuals, jacobian, self.pictures.weights)
        state.deviations = self._deviations(matrix)
        state.round += 1
        self._done = before + self._each

    def _settle_camera(self) -> None:
        """Exposure, blur and contrast alone, which need no other picture, to where they show this one best.

        What is left is the cloth's, and the derivatives are those of how it is seen.
        """
        state, settings = self.state, self.settings
        camera = np.array([name in OF_THE_CAMERA for name in self.space.names])
        moving, spread = np.flatnonzero(camera).tolist(), self.space.spread[camera]
        before = self.loss
        for _ in range(CAMERA_STEPS if moving else 0):
            rows = np.stack([self._moved_camera(k) - self.residuals for k in moving])
            matrix, gradient = normal_equations(self.residuals, rows, self.pictures.weights)
            for damping in DAMPINGS:
                point = state.point.copy()
                point[moving] += damped_step(
                    matrix, gradient, state.point[moving], spread, settings.prior, damping, LONGEST_STEP
                )
                residuals = self._residuals(self.picture, point)
                loss = self._loss(residuals, point)
                if loss < self.loss:
                    break
            else:
                break
            state.point = state.way[-1] = point
            self.residuals, self.loss = residuals, loss
        if self.loss < before:
            state.losses.append(self.loss)

    def _moved_camera(self, coordinate: int) -> Singles:
        ahead = self.state.point.copy()
        ahead[coordinate] += 1.0
        return self._residuals(self.picture, ahead)

    def _jacobian(self) -> tuple[Singles, Floats]:
        """Derivatives (P, R) at the point, and the best of the points that show them, if it is better."""
        rows = []
        here = self.state.point
        sketched, start = self._sketch(here)
        best, least = here, start
        for k, name in enumerate(self.space.names):
            if name in OF_THE_CAMERA:
                rows.append(self._moved_camera(k) - self.residuals)
                continue
            ahead = self.state.point.copy()
            ahead[k] += 1.0
            moved, loss = self._sketch(ahead)
            if loss < least:
                best, least = ahead, loss
            rows.append(moved - sketched)
        return np.stack(rows), best

    def _take(self, there: _Point) -> None:
        self.state.point = there.place
        self.state.way.append(there.place)
        self.picture, self.residuals, self.loss = there.picture, there.residuals, there.loss
        self.state.losses.append(there.loss)

    def _step(self, matrix: Floats, gradient: Floats, jacobian: Singles) -> bool:
        state, settings = self.state, self.settings
        for damping in range(state.damping, len(DAMPINGS)):
            step = damped_step(
                matrix, gradient, state.point, self.space.spread, settings.prior, DAMPINGS[damping], LONGEST_STEP
            )
            picture, residuals, loss = self._look(state.point + step)
            # What a step shows is true of it whether it leads down or not.
            broyden_update(jacobian, step, residuals - self.residuals)
            if loss < self.loss:
                self._take(_Point(state.point + step, picture, residuals, loss))
                state.damping = max(0, damping - 1)
                return True
        state.damping = len(DAMPINGS) - 1
        return False

    def _look(self, point: Floats) -> tuple[Singles, Singles, float]:
        picture = self.pictures.picture(self.space.fabric(point), self.rig)
        residuals = self._residuals(picture, point)
        loss = self._loss(residuals, point)
        self._done += 1
        self._tell(min(loss, self.loss))
        return picture, residuals, loss

    def _sketch(self, point: Floats) -> tuple[Singles, float]:
        """Residuals and loss of a picture that is only compared with others of its kind."""
        residuals = self._residuals(self.pictures.sketch(self.space.fabric(point), self.rig), point)
        self._done += 1
        self._tell(self.loss)
        return residuals, self._loss(residuals, point)

    def _loss(self, residuals: Singles, point: Floats) -> float:
        prior = 0.5 * self.settings.prior * float(np.sum((point / self.space.spread) ** 2))
        return soft_l1(residuals, self.pictures.weights) + prior

    def _residuals(self, picture: Singles, point: Floats) -> Singles:
        """Of a picture through the camera of a point."""
        blur = self.scale * self.space.blur_at(point)
        return self.pictures.residuals(picture, self.space.exposure(point), blur, self.space.contrast_at(point))

    def _tell(self, loss: float) -> None:
        self._progress(self._done, self.settings.pictures, loss)

    def _deviations(self, matrix: Floats) -> Floats:
        hessian = matrix + np.diag(self.settings.prior / self.space.spread**2)
        # A rise of the quadratic by delta is half a squared deviation.
        return np.sqrt(2.0 * SPREAD_OF_FIT * self.loss * np.diag(np.linalg.inv(hessian)))


def _arrays(state: _State) -> dict[str, NDArray]:
    return {f.name: np.asarray(getattr(state, f.name)) for f in fields(state) if getattr(state, f.name) is not None}


def _state(arrays: dict[str, NDArray]) -> _State:
    answers = tuple((question, look) for question, look in arrays["answers"].reshape(-1, 2).tolist())
    return _State(
        int(arrays["round"]), arrays["point"], arrays["losses"].tolist(), list(arrays["way"]), answers,
        float(arrays["light"]), int(arrays["damping"]), arrays["deviations"],
    )  # fmt: skip


def checked_match_quality(quality: str, seed: int = 0) -> MatchSettings:
    """The settings of a ``--quality``."""
    if quality not in QUALITIES:
        raise UsdfabError(f"there is no quality '{quality}'", place="--quality", remedy=f"use {', '.join(QUALITIES)}")
    return replace(QUALITIES[quality], seed=seed)
