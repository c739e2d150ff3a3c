import numpy as np
import pytest

from forewarp.synth.shapes import PATTERNS, Material, Surface, color_of


def surface(*positions, normal=(0.0, 0.0, 1.0)):
    position = np.array(positions, dtype=np.float64)
    return Surface(position, np.clip(position, 0, 1), np.broadcast_to(normal, position.shape))


def test_checker_by_hand():
    material = Material("checker", ((1, 1, 1), (0, 0, 0), (0.5, 0.5, 0.5)), 1.0)
    color = color_of(material, surface((0.5, 0.5, 0), (1.5, 0.5, 0), (1.5, 1.5, 0), (1.0, 0.5, 0)))
    assert color[:, 0].tolist() == [1, 0, 1, 0.5]


def test_a_cabin_has_glass_on_its_sides_and_none_on_its_roof():
    colors = tuple((float(i), 0.0, 0.0) for i in range(5))
    material, middle = Material("cabin", colors, 0.3), (0.5, 0.5, 0.6)
    assert color_of(material, surface(middle, normal=(0, -1, 0)))[0, 0] in (3, 4)
    assert color_of(material, surface(middle))[0, 0] in (0, 1)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_every_pattern_colours_any_point(pattern):
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    normals = np.random.default_rng(1).normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    colors = tuple((i / 4, 0.2, 0.3) for i in range(5))
    found = color_of(Material(pattern, colors, 0.3), Surface(points, 0.5 + 0.5 * points, normals))
    assert found.shape == (200, 3)
    assert len(np.unique(found[:, 0])) >= (1 if pattern == "plain" else 2)
