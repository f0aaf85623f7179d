"""The report of a fit: one page that needs nothing else, and pictures beside it."""

from __future__ import annotations

import base64
import math
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from cloth_drawing import Cloth, draw

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, Provenance, YarnParameters, weave_from_name
from usdfab.fit import report
from usdfab.fit.analysis import PhotoAnalysis, analyze_photo
from usdfab.fit.comparison import difference
from usdfab.fit.doubts import Doubt
from usdfab.fit.pipeline import Fit
from usdfab.fit.report_page import loss_plot
from usdfab.fit.report_table import parameter_rows
from usdfab.fit.stages import StageOutcome
from usdfab.imaging import read_image, srgb_to_linear
from usdfab.usd.drape import BALL, CAP, drape_scene

YARN = YarnParameters(count=6, radius=2e-4, fiber_count=6, albedo=(0.5, 0.5, 0.5))
CLOTH = FabricParameters(weave_from_name("plain"), (3e-3, 3e-3), YARN, YARN)
DRAWN = Cloth(weave_from_name("plain").matrix, 6, 6, size=160)
NASTY = 'a "quoted" <script>alert(1)</script> & co.png'


@cache
def analysis() -> PhotoAnalysis:
    return analyze_photo(draw(DRAWN))


def made() -> Fit:
    said = Provenance(NASTY, "0" * 64, "usdfab test", ("analysis", "raster", "path"), ("a note with <b>",))
    rough = replace(CLOTH, warp=replace(YARN, crimp=0.6))
    dyed = replace(rough, warp=replace(rough.warp, albedo=(0.4, 0.5, 0.6)))
    stages = (
        StageOutcome("analysis", CLOTH, 1.0, distance=0.9),
        StageOutcome("raster", rough, 2.0, (1.0, math.nan, 0.5), 0.7, ("<i>remark</i>",)),
        StageOutcome("path", dyed, 3.0, (0.5, 0.4), 0.6, uncertainty={"warp.albedo[0].r": 0.02}),
    )
    photo = draw(DRAWN).astype(np.float32)
    return Fit(replace(dyed, provenance=said), analysis(), photo, "--size", ("careful <now>",), stages)


class Page(HTMLParser):
    """Tags that are open, sources and links, text, and whether every tag that was opened was closed in order."""

    VOID = ("meta", "img", "line", "polyline")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href", "srcset", "xlink:href")]
        assert not any(name.startswith("on") for name, _ in attrs)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_needs_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "HEIGHT", 32)
    monkeypatch.setattr(report, "DRAPE_SIZE", (40, 30))
    steps: list[tuple[int, int]] = []
    folder = tmp_path / "report"
    paths = report.write_report(made(), folder, spp=1, asset=Path("x & y.usda"), progress=lambda *s: steps.append(s))
    names = ["photo", "after_analysis", "after_raster", "swatch", "comparison", "difference", "drape"]
    assert set(paths) == {*names, "raster_loss", "path_loss", "report"}
    assert {p.name for p in folder.iterdir()} == {p.name for p in paths.values()}
    assert steps == sorted(steps) and len({of for _, of in steps}) == 1
    text = paths["report"].read_text(encoding="utf-8")
    page = Page(text)
    assert not page.open
    assert not {"script", "link", "iframe", "object", "form"} & set(page.tags)
    assert "http" not in text and "url(" not in text and "@import" not in text
    assert page.sources and all(s.startswith("data:image/png;base64,") for s in page.sources)
    embedded = [base64.b64decode(s.partition(",")[2]) for s in page.sources]
    assert embedded == [
        paths[n].read_bytes() for n in ("photo", "after_analysis", "after_raster", "swatch", "difference", "drape")
    ]
    for said in (NASTY, "careful <now>", "<i>remark</i>", "a note with <b>", "x & y.usda", "± 0.02", "0.900"):
        assert said in page.text
    assert page.tags.count("svg") == 2
    for refused in (report.write_report, lambda _fit, there: report.check_report_folder(there)):
        with pytest.raises(UsdfabError, match="--overwrite"):
            refused(made(), folder)
    with pytest.raises(UsdfabError, match="a file is in the folder's place"):
        report.check_report_folder(paths["photo"])
    report.check_report_folder(folder, overwrite=True)
    report.check_report_folder(tmp_path / "new")
    assert read_image(paths["drape"]).pixels.shape == (30, 40, 3)


def test_each_parameter_says_where_it_comes_from() -> None:
    fit = made()
    rows = {row.name: row for row in parameter_rows(fit.fabric, fit.analysis, fit.stages)}
    assert rows["crimp"].known[0] == "raster stage" and rows["crimp"].known[1] == "prior"
    assert rows["albedo"].known[0] == "path stage, ± 0.02" and rows["albedo"].known[1].startswith("photo, confidence")
    assert rows["count"].known[0] == f"photo, confidence {fit.analysis.warp.count_confidence:.2f}"
    doubt = Doubt("blur", "it is blurred", ("twist", "warp.crimp"))
    marked = {row.name: row for row in parameter_rows(fit.fabric, fit.analysis, fit.stages, [doubt])}
    assert marked["crimp"].known == ("raster stage; doubtful: blur", "prior")
    assert all(known.endswith("; doubtful: blur") for known in marked["twist"].known)
    assert rows["fiber_radius"].known == ("from fiber_count and packing",) * 2
    assert float(rows["fiber_radius"].values[0]) == pytest.approx(1e6 * YARN.effective_fiber_radius, rel=1e-3)
    assert rows["cuticle_tilt"].known == ("default", "default")
    assert (rows["radius"].unit, rows["radius"].values[0]) == ("µm", "200")


def test_the_plot_has_the_losses_at_their_places_and_gaps() -> None:
    text = loss_plot([4.0, 2.0, math.nan, 1.0, 0.0], (480, 240))
    lines = [part.split('"')[0] for part in text.split('points="')[1:]]
    points = [[tuple(map(float, p.split(","))) for p in line.split()] for line in lines]
    assert [len(line) for line in points] == [2, 2]
    (x0, y0), (x1, y1) = points[0]
    (_, y3), (x4, y4) = points[1]
    assert x1 - x0 == pytest.approx((x4 - x0) / 4, abs=0.1)
    assert (y4 - y0) == pytest.approx(4 * (y4 - y3), abs=0.3) and y4 - y1 == pytest.approx(2 * (y4 - y3), abs=0.3)
    assert loss_plot([math.nan, math.nan]).count("polyline") == 0


def test_the_difference_finds_how_the_two_lie() -> None:
    """A picture moved by a part of the repeat differs by nothing but what was added to it."""
    picture = draw(replace(DRAWN, warp_count=8, weft_count=8, noise=0.0, wobble=0.0)).astype(np.float32)
    fabric = replace(CLOTH, warp=replace(YARN, count=8), weft=replace(YARN, count=8))
    photo = np.roll(picture, (13, -9), axis=(0, 1))[8:-8, 8:-8]
    shown, correlation = difference(photo, picture, fabric)
    assert correlation > 0.98
    np.testing.assert_allclose(np.median(shown), srgb_to_linear(0.5), atol=0.01)
    brighter, _ = difference(0.5 * photo, picture, fabric)
    assert brighter.mean() > shown.mean() + 0.02
    _, unlike = difference(np.random.default_rng(0).random(photo.shape).astype(np.float32), picture, fabric)
    assert unlike < 0.3


def test_the_drape_keeps_the_cloths_lengths() -> None:
    scene = drape_scene(CLOTH)
    cloth, floor = scene.meshes
    assert cloth.uv is not None
    points, uv = cloth.points[cloth.triangles], cloth.uv
    edges, flat = (np.linalg.norm(np.diff(p, axis=1), axis=2) for p in (points, uv))
    stretch = np.quantile(edges / flat, [0.05, 0.5, 0.95])
    assert stretch[0] > 0.8 and abs(stretch[1] - 1.0) < 0.03 and stretch[2] < 1.2
    side = np.ptp(uv[..., 0])
    # On the cap the cloth lies on the ball, and it hangs above the floor everywhere.
    reach = np.linalg.norm(uv - uv.mean(axis=(0, 1)), axis=2)
    on_ball = np.linalg.norm(points, axis=2)[reach < 0.98 * BALL * CAP * side]
    np.testing.assert_allclose(on_ball, BALL * side, rtol=1e-3)
    assert points[..., 2].min() > floor.points[:, 2].max()
