"""The match stage: shape, appearance and exposure, until the texture of path-traced pictures is the photo's.

Everything that the tracer shows takes part: light that scatters many times, gaps, shadows between yarns, flyaways,
plies. Derivatives of the texture statistics are finite differences between denoised pictures of the same random draws,
one picture for each coordinate. There are few coordinates and the statistics are smooth in them, so a few Gauss-Newton
steps do what gradient descent needs a hundred for; between two rounds of differences, derivatives are kept right by
what the steps themselves show (Broyden 1965). The statistics are those of Li et al. 2024, eq. 12.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.fabric import SYSTEMS, FabricParameters
from usdfab.files import whole_file
from usdfab.fit.match_space import EXPOSURE, MOVES, MatchSpace
from usdfab.fit.match_steps import broyden_update, damped_step, normal_equations, soft_l1
from usdfab.imaging import denoise
from usdfab.tracer import RenderSettings, Tracer
from usdfab.tracer.checkpoint import fingerprint
from usdfab.usd.rig import swatch_scene

if TYPE_CHECKING:
    from usdfab.fit.features import FeatureNet
    from usdfab.fit.texture import Kind, Target

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

FORMAT = "usdfab-match/1"
LONGEST_STEP = 2.0
DAMPINGS = (0.01, 0.1, 1.0)
"""Tried one after another until a step leads down; each iteration begins with the one that last did."""

WIDTHS = (1.0, 0.85, 0.72)
"""Of the yarns, times the start's, that are tried before the first round: how dark the valleys between yarns are
decides more than all else, and from touching yarns the way to separate ones leads uphill."""

PLIES = (1, 2)
LIGHTS = (0.75, 1.0, 1.33, 1.75)
"""Exposures, times the start's, with which each of these is seen."""

VARIED_CELLS = 16
"""Crossings of all variants of the repeat together beyond which pictures show fewer variants."""

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
        Samples per pixel of each picture, before the denoiser.
    iterations:
        Rounds of finite differences.
    steps:
        Gauss-Newton steps at most after each round.
    levels, kind:
        Of the texture statistics, see ``texture.Target``.
    prior:
        Weight of the prior, see ``match_steps.damped_step``.
    free:
        Names of ``match_space.MOVES``, and ``exposure``.
    seed:
        Of the renders.
    """

    width: int = 240
    spp: int = 4
    iterations: int = 2
    steps: int = 3
    levels: tuple[int, ...] = (1, 2, 4)
    kind: Kind = "gram"
    prior: float = 0.004
    free: tuple[str, ...] = (*MOVES, EXPOSURE)
    seed: int = 0

    @property
    def pictures(self) -> int:
        """How many pictures are rendered at most, about."""
        systems, channels = 2, 3
        coordinates = systems * (len(self.free) + (channels - 1 if "albedo" in self.free else 0))
        return len(self.starts) + self.iterations * (coordinates + self.steps * len(DAMPINGS))

    @property
    def starts(self) -> tuple[tuple[float, int], ...]:
        """Widths of yarns and numbers of plies that are tried first; one pair where shapes are not free."""
        if "radius" in self.free and "flattening" in self.free:
            return tuple((width, plies) for plies in PLIES for width in WIDTHS)
        return ((1.0, 1),)


QUALITIES: dict[str, MatchSettings] = {
    "draft": MatchSettings(width=128, spp=8, iterations=1, levels=(1, 2)),
    "standard": MatchSettings(),
    "paper": MatchSettings(width=360, spp=16, iterations=4, levels=(1, 2, 4)),
}
"""What ``--quality`` means here."""


@dataclass(frozen=True, eq=False)
class MatchResult:
    """What the stage found.

    Parameters
    ----------
    fabric, exposure:
        The best point; what its picture is multiplied by to be as bright as the target.
    losses:
        Of the start and after each step that was taken.
    uncertainty:
        Standard deviations by name in the parameters' own units: how far each may move, all others following, before
        the loss grows by ``SPREAD_OF_FIT`` of itself.
    interrupted:
        Whether Ctrl-C ended it early.
    """

    fabric: FabricParameters
    exposure: float
    losses: tuple[float, ...]
    uncertainty: dict[str, float]
    interrupted: bool


@dataclass(eq=False)
class _State:
    """Where the search stands after ``round`` rounds of differences."""

    round: int
    point: Floats
    losses: list[float]
    start: int = 0
    light: float = 1.0
    damping: int = 0
    deviations: Floats | None = None


class _Seen:
    """Pictures of fabrics, and how their statistics differ from the target's."""

    def __init__(self, target: Target, settings: MatchSettings) -> None:
        self.target, self.settings = target, settings
        weights = []
        for statistic, upper in zip(target.statistics, self._upper(target.statistics), strict=True):
            # Symmetric matrices: each pair off the diagonal stands for two entries.
            shares = np.full(len(upper[0]), 2.0, dtype=np.float32)
            shares[upper[0] == upper[1]] = 1.0
            weights.append(shares / np.float32(statistic[0].numel() * len(target.statistics)))
        self.weights: Singles = np.concatenate(weights)

    @staticmethod
    def _upper(statistics: tuple) -> list[tuple[NDArray, NDArray]]:
        return [np.triu_indices(s.shape[-1]) if s.ndim == 3 else (np.arange(s.shape[-1]),) * 2 for s in statistics]

    def picture(self, fabric: FabricParameters) -> Singles:
        """(H, W, 3) linear, denoised, at exposure 1."""
        repeat = math.prod(fabric.repeat())
        # Statistics need only so many different crossings; each is fibers to build and to keep.
        scene = swatch_scene(replace(fabric, variants=max(1, min(fabric.variants, VARIED_CELLS // repeat))))
        width = self.settings.width
        size = (width, max(1, round(width * fabric.size[1] / fabric.size[0])))
        render = Tracer(scene).render(
            scene.cameras[0], RenderSettings(size, spp=self.settings.spp, seed=self.settings.seed)
        )
        return denoise(render.pixels, render.albedo, render.normal)

    def residuals(self, picture: Singles, exposure: float) -> Singles:
        """(R,) differences of the statistics from the target's, each matrix in units of the target's mean entry."""
        import torch

        from usdfab.fit.texture import texture_statistics

        target = self.target
        with torch.inference_mode():
            image = torch.from_numpy(np.float32(exposure) * picture).permute(2, 0, 1)[None]
            found = texture_statistics(image, target.net, target.levels, target.kind)
            parts = []
            for ours, theirs, scale, upper in zip(
                found, target.statistics, target.scales, self._upper(target.statistics), strict=True
            ):
                difference = ((ours - theirs) / scale)[0].numpy()
                parts.append(difference[upper] if difference.ndim == 2 else difference)
        return np.concatenate(parts).astype(np.float32)


def match_photo(
    start: FabricParameters,
    goal: NDArray,
    settings: MatchSettings,
    *,
    net: FeatureNet,
    exposure: float = 1.0,
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
    seen = _Seen(Target.from_image(picture, net, settings.levels, settings.kind), settings)
    identity = fingerprint(start, np.asarray(goal, dtype=np.float32), settings, float(exposure))
    state = None
    if checkpoint is not None and checkpoint.exists():
        state = _load(checkpoint, identity)
    search = _Search(start, exposure, seen, settings, state, progress)
    space, state = search.space, search.state
    interrupted = False
    try:
        search.begin()
        space = search.space
        while state.round < settings.iterations:
            search.round()
            if checkpoint is not None:
                _save(checkpoint, identity, state)
    except KeyboardInterrupt:
        interrupted = True
    deviations = state.deviations if state.deviations is not None else np.zeros(len(space.names))
    return MatchResult(
        space.fabric(state.point), space.exposure(state.point), tuple(state.losses),
        {k: v for k, v in space.deviations(state.point, deviations).items() if v > 0.0}, interrupted,
    )  # fmt: skip


def first_look(start: FabricParameters, width: float, plies: int) -> FabricParameters:
    """``start`` with yarns narrower by the factor ``width``, first rounder, then thinner, and so many plies.

    The plies are twisted as the fibers were, for what a photo shows of twist is the slant of the lines on the yarn, and
    the fibers in them the other way. A yarn that has plies keeps them.
    """
    fabric = start
    for system in SYSTEMS:
        yarn = start.system(system)
        flattening = max(min(yarn.flattening, 1.0), yarn.flattening * width)
        radius = yarn.radius * width * yarn.flattening / flattening
        yarn = replace(yarn, flattening=flattening, radius=radius)
        if plies > 1 and yarn.ply_count == 1:
            yarn = replace(yarn, ply_count=plies, ply_twist=-yarn.twist)
        fabric = replace(fabric, **{system: yarn})  # type: ignore[arg-type]
    return fabric


class _Search:
    def __init__(
        self,
        start: FabricParameters,
        exposure: float,
        seen: _Seen,
        settings: MatchSettings,
        state: _State | None,
        progress: Callable[[int, int, float], None] | None,
    ) -> None:
        self.seen, self.settings, self.fresh = seen, settings, state is None
        self.space = MatchSpace.about(start, settings.free, exposure)
        self.state = state or _State(0, np.zeros(len(self.space.names)), [])
        self._progress = progress or (lambda *_: None)
        self._starts = [first_look(start, *look) for look in settings.starts]
        self._each = len(self.space.names) + settings.steps * len(DAMPINGS)
        self._done = self.state.round * self._each
        self.loss = math.inf

    def begin(self) -> None:
        """Choose a start, or look at the point where the search stood."""
        state, exposure = self.state, self.space.light
        if not self.fresh:
            self.space = replace(self.space, start=self._starts[state.start], light=exposure * state.light)
            self._done += len(self._starts) - 1
            self.picture, self.residuals, self.loss = self._look(state.point)
            return
        for k, start in enumerate(self._starts):
            picture = self.seen.picture(start)
            self._done += 1
            # Where there is no choice of starts, the start's exposure is taken as it is.
            for light in LIGHTS if len(self._starts) > 1 else (1.0,):
                residuals = self.seen.residuals(picture, exposure * light)
                loss = soft_l1(residuals, self.seen.weights)
                if k == 0 and light == 1.0:
                    state.losses.append(loss)
                if loss < self.loss:
                    self.picture, self.residuals, self.loss = picture, residuals, loss
                    state.start, state.light = k, light
            self._tell(self.loss)
        if (state.start, state.light) != (0, 1.0):
            state.losses.append(self.loss)
        self.space = replace(self.space, start=self._starts[state.start], light=exposure * state.light)

    def round(self) -> None:
        """One round of finite differences, and the steps that follow from it."""
        state, settings = self.state, self.settings
        before = self._done
        jacobian = self._jacobian()
        for _ in range(settings.steps):
            matrix, gradient = normal_equations(self.residuals, jacobian, self.seen.weights)
            if not self._step(matrix, gradient, jacobian):
                break
        matrix, _ = normal_equations(self.residuals, jacobian, self.seen.weights)
        state.deviations = self._deviations(matrix)
        state.round += 1
        self._done = before + self._each

    def _jacobian(self) -> Singles:
        rows = []
        for k, name in enumerate(self.space.names):
            ahead = self.state.point.copy()
            ahead[k] += 1.0
            if name == EXPOSURE:
                moved = self.seen.residuals(self.picture, self.space.exposure(ahead))
            else:
                _, moved, _ = self._look(ahead)
            rows.append(moved - self.residuals)
        return np.stack(rows)

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
                state.point = state.point + step
                self.picture, self.residuals, self.loss = picture, residuals, loss
                state.losses.append(loss)
                state.damping = max(0, damping - 1)
                return True
        state.damping = len(DAMPINGS) - 1
        return False

    def _look(self, point: Floats) -> tuple[Singles, Singles, float]:
        picture = self.seen.picture(self.space.fabric(point))
        residuals = self.seen.residuals(picture, self.space.exposure(point))
        prior = 0.5 * self.settings.prior * float(np.sum((point / self.space.spread) ** 2))
        loss = soft_l1(residuals, self.seen.weights) + prior
        self._done += 1
        self._tell(min(loss, self.loss))
        return picture, residuals, loss

    def _tell(self, loss: float) -> None:
        self._progress(self._done, self.settings.pictures, loss)

    def _deviations(self, matrix: Floats) -> Floats:
        hessian = matrix + np.diag(self.settings.prior / self.space.spread**2)
        # A rise of the quadratic by delta is half a squared deviation.
        return np.sqrt(2.0 * SPREAD_OF_FIT * self.loss * np.diag(np.linalg.inv(hessian)))


def _save(path: Path, identity: str, state: _State) -> None:
    about = json.dumps({"format": FORMAT, "identity": identity, "round": state.round})
    numbers = {"start": state.start, "light": state.light, "damping": state.damping, "point": state.point}
    try:
        with whole_file(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, about=about, losses=state.losses, deviations=state.deviations, **numbers)  # type: ignore[arg-type]
    except OSError as error:
        raise UsdfabError(
            f"cannot be written ({error.strerror or error})", place=str(path), remedy="make room or use another disk"
        ) from error


def _load(path: Path, identity: str) -> _State:
    try:
        with np.load(path, allow_pickle=False) as data:
            about = json.loads(str(data["about"]))
            if about["format"] != FORMAT:
                raise ValueError
            state = _State(
                int(about["round"]), data["point"], data["losses"].tolist(), int(data["start"]), float(data["light"]),
                int(data["damping"]), data["deviations"],
            )  # fmt: skip
            same = about["identity"] == identity
    except OSError as error:
        raise UsdfabError(f"cannot be read ({error.strerror or error})", place=str(path)) from error
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise UsdfabError(
            "this is no unfinished match of this version, or it is damaged",
            place=str(path),
            remedy="start anew with --overwrite",
        ) from error
    if not same:
        raise UsdfabError(
            "the unfinished match is of another photo, other options or another start",
            place=str(path),
            remedy="give the same options, or start anew with --overwrite",
        )
    return state


def checked_match_quality(quality: str, seed: int = 0) -> MatchSettings:
    """The settings of a ``--quality``."""
    if quality not in QUALITIES:
        raise UsdfabError(f"there is no quality '{quality}'", place="--quality", remedy=f"use {', '.join(QUALITIES)}")
    return replace(QUALITIES[quality], seed=seed)
