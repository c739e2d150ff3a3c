import numpy as np
import pytest

from forewarp.synth import shapes
from forewarp.synth.shapes import Material, Surface, color_of


def volume(mesh):
    vertices, faces = mesh
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.einsum("nd,nd->", np.cross(a, b), c) / 6


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_prism_is_outline_times_height_along_any_axis(axis):
    mesh = shapes.prism([(0, 0), (2, 0), (0, 3)], -1, 4, axis)
    assert volume(mesh) == pytest.approx(15)
    assert np.ptp(mesh[0], axis=0).tolist() == np.roll([2, 3, 5], axis + 1).tolist()


def test_volumes_by_hand():
    assert volume(shapes.box((0, 1, 2), (1, 3, 5))) == pytest.approx(6)
    assert volume(shapes.sphere(0.5, 60, 60)) == pytest.approx(4 / 3 * np.pi / 8, rel=5e-3)
    disc = shapes.cylinder((5, 6, 7), 0.5, 2, axis=1, segments=90)
    assert volume(disc) == pytest.approx(np.pi / 2, rel=2e-3)
    # A square less its corners' squares, plus a disc of four quarters.
    slab = shapes.rounded_slab(1, 0.4, 0, 0.5, steps=40)
    assert volume(slab) == pytest.approx((4 - 0.64 + 0.16 * np.pi) / 2, rel=1e-3)


def test_checker_by_hand():
    position = np.array([(0.5, 0.5, 0), (1.5, 0.5, 0), (1.5, 1.5, 0), (1.0, 0.5, 0)])
    upwards = np.broadcast_to((0.0, 0.0, 1.0), position.shape)
    material = Material("checker", ((1, 1, 1), (0, 0, 0), (0.5, 0.5, 0.5)), 1.0)
    color = color_of(material, Surface(position, position / 2, upwards))
    assert color[:, 0].tolist() == [1, 0, 1, 0.5]


@pytest.mark.parametrize("pattern", shapes.PATTERNS)
def test_every_pattern_colours_any_point(pattern):
    points, normals = np.random.default_rng(0).uniform(-1, 1, (2, 200, 3))
    colors = tuple((i / 4, 0.2, 0.3) for i in range(5))
    found = color_of(Material(pattern, colors, 0.3), Surface(points, 0.5 + 0.5 * points, normals))
    assert found.shape == (200, 3)
    assert len(np.unique(found[:, 0])) >= (1 if pattern == "plain" else 2)
