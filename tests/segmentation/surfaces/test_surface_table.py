import numpy as np
import pytest
from inverse_depth_lattice import inverse_depth_lattice

from nurbseg.segmentation.surfaces.surface import NurbsSurface
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable


def surface(rng, size=(6, 9), spacing=7.3):
    knots = [spacing * np.arange(-3, count + 1) + 2.0 for count in size]
    weights = rng.uniform(0.3, 2.0, size)
    points = np.stack([np.zeros(size), np.zeros(size), 1.3 / weights], axis=-1)
    return NurbsSurface((3, 3), knots[1], knots[0], points, weights, (0, 0, 60, 60))


def test_places_of_many_surfaces_are_those_of_each():
    rng = np.random.default_rng(3)
    known = [surface(rng), surface(rng, (4, 7), 11.0), surface(rng, (8, 5))]
    table = SurfaceTable([known[0], None, *known[1:]])
    labels = rng.integers(1, 5, 400).astype(np.int32)
    # Beyond the knots too.
    rows, columns = rng.integers(-3, 58, (2, 400)).astype(np.int32)
    between = rows + rng.random(400), columns + rng.random(400)
    inverse_depth = table.inverse_depths(labels, rows, columns)
    slopes = np.stack(table.slopes(labels, between[1], between[0]))
    for n, label in enumerate(labels):
        if label == 2:
            assert np.isnan([inverse_depth[n], *slopes[:, n]]).all()
            continue
        own = known[max(0, label - 2)]
        at = inverse_depth_lattice(own, columns[n : n + 1].astype(float), rows[n : n + 1].astype(float))[0]
        assert inverse_depth[n] == pytest.approx(at.item(), rel=1e-5, abs=1e-6)
        expected = [
            each.item() for each in inverse_depth_lattice(own, between[1][n : n + 1], between[0][n : n + 1])
        ]
        assert slopes[:, n] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_a_label_without_a_surface_has_no_inverse_depth():
    zero = np.zeros(1, np.int32)
    assert np.isnan(SurfaceTable([]).inverse_depths(zero, zero, zero)).all()
    assert np.isnan(SurfaceTable([None]).inverse_depths(zero + 1, zero, zero)).all()
