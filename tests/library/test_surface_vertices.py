from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nurbseg.library.meshing import Lattices, evaluate_vertices
from nurbseg.segmentation.surfaces.bspline import pixel_knots
from nurbseg.segmentation.surfaces.surface import NurbsSurface, evaluate


def surface(
    rng: np.random.Generator, window: tuple[int, int, int, int], rows: int, columns: int
) -> NurbsSurface:
    top, left, bottom, right = window
    return NurbsSurface(
        degree=(3, 3),
        knots_u=left + pixel_knots(right - left, columns),
        knots_v=top + pixel_knots(bottom - top, rows),
        control_points_m=rng.normal(size=(rows, columns, 3)),
        weights=rng.uniform(0.5, 2.0, size=(rows, columns)),
        window=window,
    )


def test_vertices_are_where_the_surfaces_own_evaluation_puts_them() -> None:
    rng = np.random.default_rng(3)
    surfaces = [
        surface(rng, (0, 0, 120, 160), 12, 20),
        surface(rng, (30, 40, 52, 61), 4, 5),
        surface(rng, (7, 9, 8, 30), 4, 7),
    ]
    lattices = Lattices.over(surfaces, 5.0)
    wanted = np.ones(lattices.vertices, dtype=bool)
    points = evaluate_vertices(surfaces, lattices, wanted)
    ends = [*lattices.start, lattices.vertices]
    for number, each in enumerate(surfaces):
        top, left, bottom, right = each.window
        rows, columns = lattices.counts[number]
        v, u = np.linspace(top, bottom - 1, rows), np.linspace(left, right - 1, columns)
        assert points[ends[number] : ends[number + 1]].reshape(rows, columns, 3) == pytest.approx(
            evaluate(each, u, v[:, np.newaxis]), abs=2e-6, rel=2e-5
        )
    some = rng.random(wanted.size) < 0.3
    np.testing.assert_array_equal(evaluate_vertices(surfaces, lattices, some), points[some])


def test_a_lattice_spans_its_window_with_steps_near_the_requested_one() -> None:
    rng = np.random.default_rng(4)
    lattices = Lattices.over([surface(rng, (10, 20, 71, 141), 5, 5)], 6.0)
    assert lattices.first.tolist() == [[10.0, 20.0]]
    assert lattices.counts.tolist() == [[11, 21]]
    assert lattices.step.tolist() == [[6.0, 6.0]]


def test_surfaces_of_another_degree_are_refused() -> None:
    rng = np.random.default_rng(5)
    cubic = surface(rng, (0, 0, 20, 20), 4, 4)
    surfaces = [cubic, replace(cubic, degree=(2, 2), knots_u=cubic.knots_u[1:], knots_v=cubic.knots_v[1:])]
    lattices = Lattices.over(surfaces, 5.0)
    with pytest.raises(ValueError, match=r"expected bicubic ones, got degree \(2, 2\)"):
        evaluate_vertices(surfaces, lattices, np.ones(lattices.vertices, dtype=bool))
