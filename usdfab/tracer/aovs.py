"""Arbitrary output variables: which layers of a render can be written, and what their channels are called in EXR files.

Names follow what compositing programs look for: ``Z`` and ``A`` belong to the picture, further layers are
``layer.channel``. Ids are whole numbers in 32-bit float channels, exact up to 2^24: OpenEXR's UINT channels are shown
by few programs, and read as fractions of 2^32 by some.
"""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import NDArray

from usdfab.errors import UsdfabError
from usdfab.tracer.render import Render

AOVS = {
    "depth": "Z",
    "normal": "normal",
    "albedo": "albedo",
    "fiber_id": "fiber_id",
    "yarn_id": "yarn_id",
    "uv": "uv",
    "direct": "direct",
    "indirect": "indirect",
    "samples": "samples",
    "variance": "variance",
    "alpha": "A",
}
"""Names for ``--aov``, and the layers they become."""


def parse_aovs(texts: Sequence[str] | None) -> tuple[str, ...]:
    """Names from what stands behind ``--aov``: names with commas or spaces between, ``all``, or nothing, which is all.

    None: no AOVs.

    Raises
    ------
    UsdfabError
        For a name that is not in ``AOVS``.
    """
    if texts is None:
        return ()
    names = [name.strip() for text in texts for name in text.split(",") if name.strip()]
    for name in names:
        if name not in AOVS and name != "all":
            raise UsdfabError(f"there is no '{name}'", place="--aov", remedy=f"choose of {', '.join(AOVS)}, all")
    return tuple(AOVS) if not names or "all" in names else tuple(dict.fromkeys(names))


def aov_layers(render: Render, names: Sequence[str]) -> dict[str, NDArray]:
    """Layers for ``imaging.write_image``: (H, W), (H, W, 2) or (H, W, 3) arrays by name."""
    return {
        AOVS[name]: render.pixels - render.direct if name == "indirect" else getattr(render, name) for name in names
    }
