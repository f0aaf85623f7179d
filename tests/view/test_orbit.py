"""Cameras that turn about what they look at."""

import math

import numpy as np
import pytest

from usdfab.view.orbit import Orbit, fitted_tangents


def looking(eye, target=(0.0, 0.0, 0.0)) -> Orbit:
    eye, target = np.asarray(eye, dtype=float), np.asarray(target, dtype=float)
    back = (eye - target) / np.linalg.norm(eye - target)
    side = np.cross([0.0, 0.0, 1.0], back)
    side /= np.linalg.norm(side)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = side, np.cross(back, side), back, eye
    return Orbit(matrix, target, np.array([0.0, 0.0, 1.0]))


def test_turning_keeps_the_target_in_the_middle_and_the_distance():
    orbit = looking((3, -4, 2), (1, 0, 0.5))
    for azimuth, elevation in ((30, 0), (0, 20), (-75, -40), (200, 500)):
        moved = orbit.turned(azimuth, elevation)
        eye, rotation = moved.to_world[:3, 3], moved.to_world[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.norm(eye - orbit.target) == pytest.approx(np.linalg.norm([2, -4, 1.5]))
        assert np.allclose(np.cross(eye - orbit.target, rotation[:, 2]), 0, atol=1e-9)
        assert rotation[2, 0] == pytest.approx(0, abs=1e-9)  # the horizon stays level
    assert np.allclose(orbit.turned(90, 0).turned(270, 0).to_world, orbit.to_world)
    # To the right of a camera that looks along +y is +x.
    assert np.allclose(looking((0, -2, 0)).turned(90, 0).to_world[:3, 3], [2, 0, 0], atol=1e-12)
    assert looking((0, -2, 0)).turned(0, 30).to_world[2, 3] == pytest.approx(1.0)
    assert looking((0, -2, 0)).turned(0, 400).to_world[2, 3] == pytest.approx(2 * math.sin(math.radians(89)))


def test_a_camera_straight_above_turns_about_the_axis_and_comes_down():
    above = Orbit(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0], [0, 0, 0, 1]]), np.zeros(3), np.eye(3)[2])
    assert np.allclose(above.turned(40, 0).to_world[:3, 3], [0, 0, 2])
    assert above.turned(0, 10).to_world[2, 3] == pytest.approx(2.0)
    assert above.turned(0, -60).to_world[:3, 3] == pytest.approx([0, -2 * math.sin(math.radians(60)), 1])


def test_zoom_and_pan():
    orbit = looking((0, -2, 0))
    assert np.allclose(orbit.zoomed(4).to_world[:3, 3], [0, -0.5, 0])
    # A tenth of the width at the target's distance.
    moved = orbit.panned(0.1, 0.0, np.array([0.5, 0.25]))
    assert np.allclose(moved.to_world[:3, 3], [-0.2, -2, 0]) and np.allclose(moved.target, [-0.2, 0, 0])
    assert np.allclose(orbit.panned(0.0, 0.1, np.array([0.5, 0.25])).target, [0, 0, -0.1])


def test_pictures_of_another_shape_show_no_less():
    assert np.allclose(fitted_tangents(np.array([0.4, 0.3]), 400, 300), [0.4, 0.3])
    assert np.allclose(fitted_tangents(np.array([0.4, 0.3]), 800, 300), [0.8, 0.3])
    assert np.allclose(fitted_tangents(np.array([0.4, 0.3]), 400, 600), [0.4, 0.6])
