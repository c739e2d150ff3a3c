import numpy as np
import pytest

from forewarp.synth.shapes import box, cylinder, joined, prism, rounded_slab, sphere, studs


def volume(mesh):
    vertices, faces = mesh
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.einsum("nd,nd->", np.cross(a, b), c) / 6


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_prism_is_outline_times_height_along_any_axis(axis):
    mesh = prism([(0, 0), (2, 0), (0, 3)], -1, 4, axis)
    assert volume(mesh) == pytest.approx(15)
    assert np.ptp(mesh[0], axis=0).tolist() == np.roll([2, 3, 5], axis + 1).tolist()


def test_volumes_by_hand():
    assert volume(box((0, 1, 2), (1, 3, 5))) == pytest.approx(6)
    assert volume(sphere(0.5, 60, 60)) == pytest.approx(4 / 3 * np.pi / 8, rel=5e-3)
    assert volume(cylinder((5, 6, 7), 0.5, 2, axis=1, segments=90)) == pytest.approx(np.pi / 2, rel=2e-3)
    # A square less its corners' squares, plus a disc of four quarters.
    slab = rounded_slab(1, 0.4, 0, 0.5, steps=40)
    assert volume(slab) == pytest.approx((4 - 0.64 + 0.16 * np.pi) / 2, rel=1e-3)


def test_joined_meshes_keep_their_own_vertices():
    first, second = box((0, 0, 0), (1, 1, 1)), box((2, 0, 0), (3, 2, 1))
    vertices, faces = joined([first, second])
    np.testing.assert_array_equal(vertices[faces[len(first[1]) :]], second[0][second[1]])
    assert volume((vertices, faces)) == pytest.approx(3)


def test_a_stud_for_every_place():
    one, six = studs([0], [0], 1.0), studs([0, 1, 2], [0, 5], 1.0)
    assert volume(six) == pytest.approx(6 * volume(one))
    assert six[0][:, 2].min() < 1.0 < six[0][:, 2].max()
