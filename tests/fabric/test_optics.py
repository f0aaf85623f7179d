"""The optical parameters of a fabric as one vector."""

from dataclasses import replace

import numpy as np
import pytest

from usdfab.errors import UsdfabError
from usdfab.fabric import FabricParameters, YarnParameters
from usdfab.fabric.optics import optics_of, with_optics

RED, BLUE, GREY = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8), (0.5, 0.5, 0.5)


@pytest.fixture
def striped() -> FabricParameters:
    weft = YarnParameters(yarn_albedo=(RED, RED, BLUE, RED), roughness_primary=0.2, ior=1.5)
    return FabricParameters(warp=YarnParameters(albedo=GREY), weft=weft)


def test_colours_are_listed_once_and_named(striped):
    optics = optics_of(striped)
    assert optics.albedo.tolist() == [list(GREY), list(RED), list(BLUE)]
    assert optics.system.tolist() == [0, 1, 1]
    values = dict(zip(optics.names(), optics.vector(), strict=True))
    assert values["warp.albedo[0].g"] == 0.5
    assert values["weft.albedo[1].b"] == 0.8
    assert values["weft.roughness_primary"] == 0.2
    assert values["weft.ior"] == 1.5


def test_the_vector_goes_there_and_back(striped):
    optics = optics_of(striped)
    assert with_optics(striped, optics) == striped
    moved = optics.vector() * np.linspace(0.9, 1.1, optics.size)
    back = optics_of(with_optics(striped, optics.with_vector(moved)))
    np.testing.assert_array_equal(back.vector(), moved)


def test_stripes_keep_their_order(striped):
    optics = optics_of(striped)
    new = replace(optics, albedo=np.array([GREY, (0.2, 0.3, 0.4), (0.6, 0.7, 0.9)]))
    assert with_optics(striped, new).weft.yarn_albedo == (
        (0.2, 0.3, 0.4), (0.2, 0.3, 0.4), (0.6, 0.7, 0.9), (0.2, 0.3, 0.4),
    )  # fmt: skip


def test_what_does_not_fit_is_said(striped):
    optics = optics_of(striped)
    with pytest.raises(UsdfabError, match="expected 17"):
        optics.with_vector(np.zeros(14))
    with pytest.raises(UsdfabError, match="colours"):
        with_optics(FabricParameters(), optics)
    with pytest.raises(UsdfabError, match="roughness_primary"):
        with_optics(striped, optics.with_vector(np.r_[optics.vector()[:-3], np.nan, 1.5, 1.5]))
