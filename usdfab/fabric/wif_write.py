"""Writing fabrics as weavers' drafts (WIF 1.1): what ``read_wif`` and weaving programs read back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from usdfab._version import __version__
from usdfab.errors import UsdfabError
from usdfab.fabric.draft import loom_of, period
from usdfab.fabric.fabric import Color, FabricParameters, YarnParameters
from usdfab.fabric.weave import MAX_REPEAT
from usdfab.fabric.wif import MAX_THREADS, WIF_SUFFIXES
from usdfab.files import checked_output, whole_file
from usdfab.srgb import linear_to_srgb

MAX_TREADLES = 40
"""With more treadles than any loom has, a lift plan is written instead of a tie-up."""


def write_wif(path: str | Path, fabric: FabricParameters, *, overwrite: bool = False) -> Path:
    """Write a repeat of ``fabric`` as a draft and return the path.

    Weave, colours (sRGB, 8 bits a channel), spacing and thickness go into the file; of a fabric it holds nothing else.
    Each end is on one shaft, equal ends share it. Up to ``MAX_TREADLES`` treadles there is a tie-up with a treadling,
    beyond a lift plan.

    Raises
    ------
    UsdfabError
        For another suffix than .wif, an existing file unless ``overwrite``, a folder that is missing or not writable,
        and a repeat of weave and colours above ``MAX_THREADS``.
    """
    target = checked_output(path, WIF_SUFFIXES, overwrite=overwrite, kind="drafts")
    text = wif_text(fabric)
    try:
        with whole_file(target) as temporary:
            # Most weaving programs run on Windows.
            temporary.write_bytes(text.replace("\n", "\r\n").encode("utf-8"))
    except OSError as error:
        raise UsdfabError(f"cannot be written ({error.strerror})", place=str(target)) from error
    return target


def wif_text(fabric: FabricParameters) -> str:
    """One repeat of ``fabric`` as the text of a WIF file."""
    picks, ends = fabric.repeat()
    # The reader refuses repeats above MAX_REPEAT: a file that only other programs can read is still of use.
    if max(picks, ends) > max(MAX_THREADS, MAX_REPEAT):
        raise UsdfabError(
            f"weave and colours repeat after {picks} picks and {ends} ends, above {MAX_THREADS}",
            remedy="choose colour sequences that fit the weave",
        )
    warp, weft = (_codes(fabric.system(s).colors()) for s in ("warp", "weft"))
    matrix = np.tile(fabric.weave.matrix, (picks // fabric.weave.picks, ends // fabric.weave.ends))
    copies = _copies(matrix, weft), _copies(matrix.T, warp)
    picks, ends = picks * copies[0], ends * copies[1]
    # Its own checks would refuse what is above MAX_REPEAT.
    loom = loom_of(np.tile(matrix, copies))
    table = sorted(set(warp) | set(weft), key=[*warp, *weft].index)
    numbers = {code: k + 1 for k, code in enumerate(table)}
    treadled = loom.treadles <= MAX_TREADLES
    if treadled:
        shedding = {
            "TIEUP": (_list(row) for row in loom.tieup),
            "TREADLING": (str(k + 1) for k in loom.treadling),
        }
    else:
        shedding = {"LIFTPLAN": (_list(row) for row in loom.lift)}
    title = " ".join("".join(c if c.isprintable() else " " for c in fabric.name).split())
    sections: dict[str, Iterable[str]] = {
        "TEXT": [f"Title={title}"],
        "WEAVING": [f"Shafts={loom.shafts}", f"Treadles={loom.treadles if treadled else loom.shafts}", "Rising Shed=1"],
        "WARP": _system(fabric.warp, ends, fabric.cell[0], numbers[warp[0]]),
        "WEFT": _system(fabric.weft, picks, fabric.cell[1], numbers[weft[0]]),
        "COLOR PALETTE": [f"Entries={len(table)}", "Range=0,255"],
        "COLOR TABLE": _numbered(",".join(map(str, code)) for code in table),
        "THREADING": _numbered(str(k + 1) for k in loom.threading),
        **{name: _numbered(lines) for name, lines in shedding.items()},
        "WARP COLORS": _numbered(str(numbers[warp[k % len(warp)]]) for k in range(ends)),
        "WEFT COLORS": _numbered(str(numbers[weft[k % len(weft)]]) for k in range(picks)),
    }
    # Date and developers are those of the specification, as it demands, not of the file.
    head = ["Version=1.1", "Date=April 20, 1997", "Developers=wif@mhsoft.com"]
    head += ["Source Program=usdfab", f"Source Version={__version__}"]
    blocks = {"WIF": head, "CONTENTS": [f"{name}=true" for name in sections], **sections}
    return "\n".join(line for name, lines in blocks.items() for line in (f"[{name}]", *lines, ""))


def _copies(lines: NDArray[np.uint8], codes: Sequence[tuple[int, ...]]) -> int:
    """How often to write a repeat: twice if its end looks like a shorter repeat that was cut off (plain, 5 picks)."""
    tokens = [(line.tobytes(), codes[k % len(codes)]) for k, line in enumerate(np.ascontiguousarray(lines))]
    return 2 if len(tokens) % period(tokens) else 1


def _system(yarn: YarnParameters, threads: int, spacing: float, color: int) -> list[str]:
    width = 2.0 * yarn.radius * yarn.flattening
    return [
        f"Threads={threads}",
        f"Color={color}",
        "Units=Centimeters",
        f"Spacing={_decimal(100.0 * spacing)}",
        f"Thickness={_decimal(100.0 * width)}",
    ]


def _decimal(value: float) -> str:
    """Six significant digits without an exponent, which few programs read."""
    digits = max(0, 5 - int(np.floor(np.log10(value))))
    return f"{value:.{digits}f}"


def _codes(colors: Iterable[Color]) -> list[tuple[int, ...]]:
    codes = np.round(255.0 * linear_to_srgb(np.clip(np.asarray(list(colors)), 0.0, 1.0))).astype(int)
    return [tuple(int(v) for v in code) for code in codes]


def _numbered(lines: Iterable[str]) -> list[str]:
    return [f"{k}={line}" for k, line in enumerate(lines, start=1)]


def _list(row: np.ndarray) -> str:
    return ",".join(str(k + 1) for k in np.flatnonzero(row))
