"""The weaves that the network tells apart: the paper's seven classes, and families of all others."""

from __future__ import annotations

from usdfab.errors import UsdfabError
from usdfab.fabric.sampling_weaves import OTHER, weave_class
from usdfab.fabric.weave import NAMED_WEAVES, PAPER_WEAVES, Weave

LABELS = (*PAPER_WEAVES, "other_twill", "other_satin", "basket", "other")
"""In the order of the network's outputs. ``other_...``: of that family, but none of Table 4 of Li et al. 2024."""

FAMILIES = ("plain", "twill", "satin", "basket", "other")
"""What ``Weave.classify`` says."""

_TYPICAL = {"other_twill": "twill_2_2", "other_satin": "satin_8x8", "basket": "basket", "other": "crepe"}


def weave_label(weave: Weave) -> str:
    """The one of ``LABELS`` that a weave is; mirror images and the place where the repeat starts do not matter."""
    named = weave_class(weave)
    if named != OTHER:
        return named
    family = weave.classify()
    return f"other_{family}" if family in ("twill", "satin") else family if family == "basket" else OTHER


def family_of(label: str) -> str:
    """The one of ``FAMILIES`` that a label belongs to.

    Raises
    ------
    UsdfabError
        For an unknown label.
    """
    return typical_weave(label).classify()


def typical_weave(label: str) -> Weave:
    """The commonest weave with a label; for a twill the line's direction is a guess.

    Raises
    ------
    UsdfabError
        For an unknown label.
    """
    if label not in LABELS:
        raise UsdfabError(f"there is no weave label '{label}'", remedy=f"use one of {', '.join(LABELS)}")
    return NAMED_WEAVES[_TYPICAL.get(label, label)]
