"""The neural material against the surface model that it learned: errors at few samples and in equal time.

Ground truth is the surface model in the neural renderer's own scene, so that nothing but the material differs: a
``SurfacePlan`` answers queries by Monte Carlo over the footprint (``aggregation``).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from usdfab.imaging import flip, mse
from usdfab.neural.aggregation import aggregate
from usdfab.neural.decoder import plans_of
from usdfab.neural.evaluation_scenes import CELL, Stage, stages, zoom_stages
from usdfab.neural.material_file import Weights
from usdfab.neural.network import KINDS
from usdfab.neural.render import render
from usdfab.neural.rendered_material import reversed_material
from usdfab.neural.stage_scene import NeuralScene, build
from usdfab.neural.surface_material import SurfaceMaterial

Floats = NDArray[np.float64]
Progress = Callable[[int, int, str], None]

TRUTH = 256
"""Samples of the ground truth, as in the paper."""

FEW = (1, 3)
"""Samples of the surface model that are compared, as in the paper."""

NEURAL = "neural"
SHIFTS = 4
"""Renders with the camera moved by parts of a pixel, whose differences are aliasing."""


@dataclass(frozen=True)
class Scale:
    """How much is rendered: pixels on a side, steps of the zoom; and how much the ablations train."""

    pixels: int = 128
    zoom: int = 5
    zoom_pixels: int = 64
    materials: int = 14
    queries: int = 1500
    epochs: int = 12
    seed: int = 0


SCALES = {"draft": Scale(), "standard": Scale(256, 9, 128, 28, 4000, 24), "paper": Scale(512, 17, 256, 105, 20_000, 40)}
"""By the names of ``--quality``."""


class SurfacePlan:
    """Answers as the surface model does, in the place of a network's ``Plan``."""

    def __init__(self, material: SurfaceMaterial, transmission: bool, samples: int, seed: int) -> None:
        self.material, self.transmission, self.samples, self.seed = material, transmission, samples, seed
        self.seconds = 0.0

    def decode(self, queries: NDArray) -> NDArray[np.float32]:
        """C_warp, C_weft, S_warp, S_weft (N, 4) of queries (N, 8)."""
        begun = time.perf_counter()
        # Every call has places of its own in the footprints: bands of pixels would look alike.
        seed = self.seed + int(np.abs(queries[0, :2]).sum() * 1e6)
        found = aggregate(
            self.material, queries, transmission=self.transmission, samples=self.samples, seed=seed, threads=1
        )
        self.seconds += time.perf_counter() - begun
        return found


class TimedPlan:
    """A network's plan, and how long its answers took."""

    def __init__(self, plan: Any) -> None:
        self.plan, self.seconds = plan, 0.0

    def decode(self, queries: NDArray) -> NDArray[np.float32]:
        """As the plan's."""
        begun = time.perf_counter()
        found = self.plan.decode(queries)
        self.seconds += time.perf_counter() - begun
        return found


@dataclass(frozen=True)
class Row:
    """A way to shade a scene: its errors, and seconds of one thread that its answers took."""

    scene: str
    seen: bool
    method: str
    samples: int
    mse: float
    flip: float
    seconds: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """All rows; pictures (H, W, 3) by scene, in the order of methods and last the truth; see ``zoom_rows``."""

    rows: list[Row]
    pictures: dict[str, list[Floats]]
    zoom: list[dict[str, float]]
    zoom_pictures: list[list[Floats]]


def prepared(stage: Stage, networks: Mapping[str, Weights]) -> NeuralScene:
    """The stage with the shared networks' plans of its surface materials."""
    made = build(stage.scene, networks, {}, own=False)
    sides = [side for cloth in stage.cloths for side in (cloth.material, reversed_material(cloth.material))]
    both = [plans_of(networks[kind].network, sides) for kind in KINDS]
    plans: list[Any] = [TimedPlan(both[kind][k]) for k in range(len(sides)) for kind in range(len(KINDS))]
    albedo = np.stack([cloth.albedo for cloth in stage.cloths]).astype(np.float32)
    return replace(made, plans=plans, decoders=None, albedo=albedo)


def with_surface(made: NeuralScene, stage: Stage, samples: int, seed: int) -> NeuralScene:
    """The same scene with the surface model's answers."""
    sides = [side for cloth in stage.cloths for side in (cloth.material, reversed_material(cloth.material))]
    plans: list[Any] = [SurfacePlan(side, below, samples, seed) for side in sides for below in (False, True)]
    return replace(made, plans=plans, decoders=None)


def shown(
    made: NeuralScene, stage: Stage, pixels: int, shift: tuple[float, float] = (0.0, 0.0)
) -> tuple[Floats, float]:
    """The picture, with the camera's film moved by parts of a pixel, and the seconds that answers took."""
    camera = replace(stage.camera, offset=stage.camera.offset + 2.0 * np.asarray(shift) / pixels)
    for plan in made.plans:
        plan.seconds = 0.0  # type: ignore[attr-defined]
    found = render(made, camera, (pixels, pixels), (0, 0, pixels, pixels))
    return found.pixels.astype(np.float64), sum(plan.seconds for plan in made.plans)  # type: ignore[attr-defined]


def compare(stage: Stage, networks: Mapping[str, Weights], scale: Scale) -> tuple[list[Row], list[Floats]]:
    """The network, the surface model at few samples and with as many as take equally long, and the truth."""
    made = prepared(stage, networks)
    shown(made, stage, 8)  # compile
    shown(with_surface(made, stage, 1, scale.seed), stage, 8)  # the tile's horizons, once for a material
    truth, _ = shown(with_surface(made, stage, TRUTH, scale.seed + 1), stage, scale.pixels)
    rows, pictures = [], []

    def add(method: str, samples: int, picture: Floats, seconds: float) -> None:
        errors = mse(picture, truth), flip(picture, truth)
        rows.append(Row(stage.name, stage.seen, method, samples, *errors, seconds))
        pictures.append(picture)

    picture, seconds = shown(made, stage, scale.pixels)
    add(NEURAL, 1, picture, seconds)
    taken = {}
    for samples in FEW:
        found, taken[samples] = shown(with_surface(made, stage, samples, scale.seed + 2), stage, scale.pixels)
        add(f"surface {samples}", samples, found, taken[samples])
    # The cost of a query and of a sample, from both renders.
    each = max((taken[FEW[1]] - taken[FEW[0]]) / (FEW[1] - FEW[0]), 1e-9)
    equal = int(np.clip(1 + (seconds - taken[FEW[0]]) / each, 1, TRUTH))
    found, took = shown(with_surface(made, stage, equal, scale.seed + 3), stage, scale.pixels)
    add("equal time", equal, found, took)
    return rows, [*pictures, truth]


def zoom_rows(
    networks: Mapping[str, Weights], scale: Scale, progress: Callable[[], None]
) -> tuple[list[dict[str, float]], list[list[Floats]]]:
    """Aliasing on the way out: how much pixels change when the camera moves by parts of a pixel.

    ``neural``, ``surface_1``, ``truth``: root mean square over pixels of the deviation among ``SHIFTS`` such renders,
    over the mean of the picture. What is left of the truth's is the pattern itself that passes through pixels.
    ``tiles``: a pixel's width on the cloth where it is seen in the middle; ``mse``: of the network's picture.
    """
    rows, pictures = [], []
    for stage in zoom_stages(scale.zoom):
        made = prepared(stage, networks)
        ways = {
            NEURAL: made, "surface_1": with_surface(made, stage, 1, scale.seed),
            "truth": with_surface(made, stage, TRUTH // SHIFTS, scale.seed + 1),
        }  # fmt: skip
        distance = float(np.linalg.norm(stage.camera.to_world[:3, 3]))
        wide = CELL * stage.cloths[0].material.columns
        row: dict[str, float] = {"tiles": float(2.0 * distance * stage.camera.tan_half[0] / scale.zoom_pixels / wide)}
        line = []
        for name, way in ways.items():
            frames = np.stack([
                shown(way, stage, scale.zoom_pixels, (k % 2 / 2.0, k // 2 / 2.0))[0] for k in range(SHIFTS)
            ])  # fmt: skip
            deviation = np.sqrt(frames.var(axis=0).mean())
            row[name] = float(deviation / max(frames.mean(), 1e-12))
            line.append(frames[0])
        row["mse"] = mse(line[0], line[2])
        rows.append(row)
        pictures.append(line)
        progress()
    return rows, pictures


def evaluate(networks: Mapping[str, Weights], scale: Scale, progress: Progress | None = None) -> Evaluation:
    """All scenes and the zoom."""
    todo: Sequence[Stage] = stages()
    total, done = len(todo) + scale.zoom, 0

    def step(text: str) -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total, text)

    rows: list[Row] = []
    pictures: dict[str, list[Floats]] = {}
    for stage in todo:
        found, pictures[stage.name] = compare(stage, networks, scale)
        rows += found
        step(stage.name)
    zoom, zoom_pictures = zoom_rows(networks, scale, lambda: step("zoom"))
    return Evaluation(rows, pictures, zoom, zoom_pictures)


def summary(result: Evaluation) -> dict[str, Any]:
    """For ``--json`` and the file."""
    return {"rows": [asdict(row) for row in result.rows], "zoom": result.zoom}


def format_evaluation(result: Evaluation) -> str:
    """The tables as text."""
    lines = [f"{'scene':<26}{'material':<9}{'method':<12}{'samples':>8}{'MSE':>11}{'FLIP':>8}{'ms':>9}"]
    for r in result.rows:
        kind = "seen" if r.seen else "unseen"
        lines.append(
            f"{r.scene:<26}{kind:<9}{r.method:<12}{r.samples:>8}{r.mse:>11.6f}{r.flip:>8.4f}{1e3 * r.seconds:>9.0f}"
        )
    head = f"{'zoom: tiles a pixel':<20}{NEURAL:>9}{'surface 1':>11}{'truth':>9}{'MSE':>11}"
    lines += ["", f"{head}   change within a pixel over the mean; MSE of the network"]
    for z in result.zoom:
        changes = f"{z[NEURAL]:>9.4f}{z['surface_1']:>11.4f}{z['truth']:>9.4f}"
        lines.append(f"{z['tiles']:<20.3f}{changes}{z['mse']:>11.6f}")
    return "\n".join(lines)
