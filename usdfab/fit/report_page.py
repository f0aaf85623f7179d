"""The report of a fit as one HTML page: pictures inside, no scripts, nothing from a network."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from usdfab.fabric import SYSTEMS, FabricParameters, Weave, hex_color
from usdfab.fit.pipeline import Fit
from usdfab.fit.report_table import Row, parameter_rows
from usdfab.fit.stages import StageOutcome

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1d1d1f; background: #fff; max-width: 72rem; margin: 2rem auto;
  padding: 0 1.5rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .6rem; border-bottom: 1px solid #ddd; padding-bottom: .25rem; }
p.lead { color: #555; margin: 0 0 1.2rem; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(18rem, 1fr)); gap: 1rem; align-items: start; }
figure { margin: 0; }
figure img, figure svg { width: 100%; height: auto; display: block; border-radius: 3px; background: #f4f4f4; }
figcaption { font-size: .88rem; color: #555; margin-top: .3rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; width: 100%; }
th, td { text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid #eee; vertical-align: top; }
th { color: #555; font-weight: 600; }
th.n, td.n { text-align: right; white-space: nowrap; }
td.k { color: #666; font-size: .84rem; }
ul.warnings { background: #fff7e6; border-left: 4px solid #e0a100; padding: .7rem 1rem .7rem 2rem; }
code { font-size: .92em; background: #f4f4f4; padding: .05rem .3rem; overflow-wrap: anywhere; }
.swatch { display: inline-block; width: .9em; height: .9em; border: 1px solid #0003; vertical-align: -.1em; }
table.weave { width: auto; } table.weave td { width: .8rem; height: .8rem; padding: 0; border: 1px solid #ccc; }
table.weave td.up { background: #34495e; }
@media print { body { margin: 0; max-width: none; } h2 { break-after: avoid; } figure, tr { break-inside: avoid; } }
"""

CAPTIONS = {
    "photo": "The photo",
    "after_analysis": "After the analysis",
    "after_raster": "After the raster stage",
    "swatch": "The fit, every fiber traced",
    "difference": "Fit minus photo, laid over each other: grey where they are alike, brighter where the fit is",
    "drape": "The fit as cloth over a ball",
}
COMPARED = ("photo", "after_analysis", "after_raster", "swatch", "difference")


def report_page(
    fit: Fit, pictures: Mapping[str, Path], *, asset: Path | None = None, correlation: float | None = None
) -> str:
    """The page.

    Parameters
    ----------
    pictures:
        PNG files by name, see ``report.write_report``; they are put into the page.
    asset:
        The USD file that the fit was written to.
    correlation:
        Of the fit with the photo, see ``comparison.difference``.
    """
    said = fit.fabric.provenance
    parts = [
        f"<h1>{escape(fit.fabric.name)}</h1>",
        f'<p class="lead">Fitted to <code>{escape(said.source)}</code> by {escape(said.generator)}; '
        f"stages: {escape(', '.join(said.stages))}.</p>",
        _asset(asset),
        _warnings(fit.warnings),
        "<h2>Photo and fit</h2>",
        '<div class="pictures">',
        *(_figure(pictures[n], _caption(n, correlation)) for n in COMPARED if n in pictures),
        "</div>",
        "<h2>The fabric</h2>",
        _facts(fit),
        "<h2>Parameters</h2>",
        _parameters(parameter_rows(fit.fabric, fit.analysis, fit.stages, fit.doubts)),
        "<h2>Stages</h2>",
        _stages(fit.stages),
        *([_figure(pictures["drape"], CAPTIONS["drape"], "<h2>On a drape</h2>")] if "drape" in pictures else []),
        "<h2>Notes</h2>",
        _list(said.notes),
        f'<p class="lead">SHA-256 of the photo: <code>{escape(said.source_sha256)}</code></p>',
    ]
    title = escape(f"{fit.fabric.name}: a fabric fitted to {said.source}")
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{title}</title>\n'
        f"<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body>\n</html>\n"
    )


def _caption(name: str, correlation: float | None) -> str:
    text = CAPTIONS[name]
    return f"{text} (correlation {correlation:.2f})" if name == "difference" and correlation is not None else text


def _figure(path: Path, caption: str, heading: str = "") -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    text = escape(caption)
    return (
        f'{heading}<figure><img src="data:image/png;base64,{data}" alt="{text}">'
        f"<figcaption>{text} <code>{escape(path.name)}</code></figcaption></figure>"
    )


def _asset(asset: Path | None) -> str:
    if asset is None:
        return ""
    path = escape(str(asset))
    return f"<p>The fabric is in <code>{path}</code>. To render it: <code>usdfab render {path} -o swatch.png</code></p>"


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return "<p>Nothing was found that makes the fit doubtful.</p>"
    return f'<ul class="warnings">{"".join(f"<li>{escape(w)}</li>" for w in warnings)}</ul>'


def _list(texts: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in texts)}</ul>" if texts else "<p>None.</p>"


def _facts(fit: Fit) -> str:
    fabric, seen = fit.fabric, fit.analysis
    weave = fabric.weave
    rows = [
        (
            "Weave",
            f"{weave.classify()}, repeat {weave.picks} picks x {weave.ends} ends",
            f"confidence {seen.weave_confidence:.2f}",
        ),
        ("Size", f"{fabric.size[0] * 1e3:.4g} x {fabric.size[1] * 1e3:.4g} mm", f"from {fit.size_source}"),
        ("Ends", f"{0.01 / fabric.cell[0]:.1f} per cm", f"confidence {seen.warp.count_confidence:.2f}"),
        ("Picks", f"{0.01 / fabric.cell[1]:.1f} per cm", f"confidence {seen.weft.count_confidence:.2f}"),
        ("Cover", f"warp {fabric.cover('warp'):.2f}, weft {fabric.cover('weft'):.2f}", "width over spacing"),
        (
            "Turned",
            f"{math.degrees(seen.rotation):.1f}° in the photo",
            f"confidence {seen.rotation_confidence:.2f}",
        ),
        ("Lattice", "two yarn systems found", f"confidence {seen.lattice_confidence:.2f}"),
    ]
    cells = "".join(f"<tr><th>{a}</th><td>{escape(b)}</td><td class=k>{escape(c)}</td></tr>" for a, b, c in rows)
    return f"<table>{cells}</table>{_colors(fabric)}{_weave(weave)}"


def _colors(fabric: FabricParameters) -> str:
    """What each system's fibers are dyed with."""
    lines = []
    for system in SYSTEMS:
        yarns = "".join(
            f'<span class="swatch" style="background:{hex_color(c)}"></span>' for c in fabric.system(system).colors()
        )
        lines.append(f"<p>Fiber albedo, {system}: {yarns}</p>")
    return "".join(lines)


def _weave(weave: Weave) -> str:
    rows = "".join(
        f"<tr>{''.join('<td></td>' if up else '<td class=up></td>' for up in row)}</tr>" for row in weave.matrix[::-1]
    )
    return f"<p>One repeat, dark where the warp is on top:</p><table class=weave>{rows}</table>"


def _parameters(rows: Sequence[Row]) -> str:
    systems = "".join(f"<th class=n>{system}</th><th></th>" for system in SYSTEMS)
    head = f"<tr><th>parameter</th><th>symbol</th><th>unit</th>{systems}</tr>"
    body = "".join(
        f"<tr><td>{escape(r.name)}</td><td>{escape(r.symbol)}</td><td>{escape(r.unit)}</td>"
        + "".join(
            f"<td class=n>{escape(v)}</td><td class=k>{escape(k)}</td>" for v, k in zip(r.values, r.known, strict=True)
        )
        + "</tr>"
        for r in rows
    )
    return (
        "<p>“Prior” is a typical value of woven cloth that the photo did not decide; ± is by how much a parameter can "
        f'change, the others following, before the picture looks different.</p><div class="scroll"><table>{head}{body}'
        "</table></div>"
    )


def _stages(stages: Sequence[StageOutcome]) -> str:
    numbers = "".join(f"<th class=n>{name}</th>" for name in ("seconds", "iterations", "distance"))
    head = f"<tr><th>stage</th>{numbers}<th>remarks</th></tr>"
    body = "".join(
        f"<tr><td>{escape(s.name)}</td><td class=n>{s.seconds:.0f}</td><td class=n>{len(s.losses) or '–'}</td>"
        f"<td class=n>{'–' if s.distance is None else f'{s.distance:.3f}'}</td>"
        f"<td class=k>{escape('; '.join(s.notes))}</td></tr>"
        for s in stages
    )
    curves = "".join(
        f"<figure>{loss_plot(s.losses)}<figcaption>Loss of the {escape(s.name)} stage</figcaption></figure>"
        for s in stages
        if len(s.losses) > 1
    )
    return (
        "<p>Distance: texture and colour of the path-traced swatch against the photo; smaller is closer.</p>"
        f'<div class="scroll"><table>{head}{body}</table></div>'
        + (f'<div class="pictures" style="margin-top:1rem">{curves}</div>' if curves else "")
    )


def loss_plot(losses: Sequence[float], size: tuple[int, int] = (480, 240)) -> str:
    """Losses, N > 1, as SVG: iterations to the right, loss upwards from 0; a gap where one is not finite."""
    width, height = size
    left, right, top, bottom = 48, 12, 12, 34
    finite = [x for x in losses if math.isfinite(x)]
    high = 1.05 * max(finite, default=1.0) or 1.0
    across, up = width - left - right, height - top - bottom

    def place(k: int, loss: float) -> str:
        return f"{left + across * k / (len(losses) - 1):.1f},{top + up * (1.0 - loss / high):.1f}"

    runs: list[list[str]] = [[]]
    for k, loss in enumerate(losses):
        if math.isfinite(loss):
            runs[-1].append(place(k, loss))
        elif runs[-1]:
            runs.append([])
    lines = "".join(
        f'<polyline points="{" ".join(run)}" fill="none" stroke="#1f4e8c" stroke-width="2" stroke-linejoin="round"/>'
        for run in runs
        if len(run) > 1
    )
    ticks = "".join(
        f'<line x1="{left}" x2="{width - right}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>'
        f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{high * (1.0 - k / 4):.3g}</text>'
        for k in range(5)
        for y in [top + up * k / 4]
    )
    label = f'<text x="{left + across / 2}" y="{height - 8}" text-anchor="middle">iteration, 1 to {len(losses)}</text>'
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="loss by iteration" font-size="12" '
        f'font-family="sans-serif" fill="#444">{ticks}{label}{lines}</svg>'
    )
