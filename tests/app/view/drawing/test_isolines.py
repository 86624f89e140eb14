from __future__ import annotations

import numpy as np

from nurbseg.app.view.drawing.isolines import isolines
from nurbseg.app.view.drawing.surface_mesh import surface_mesh
from nurbseg.app.view.drawing.surface_samples import Lattices
from tests.fakes.small_scene import small_result


def traced(count: list[tuple[int, int]], row_of: list[int], every: int) -> list[list[int]]:
    """Follow each row, then each column, vertex by vertex."""
    along_rows: list[list[int]] = []
    along_columns: list[list[int]] = []
    start = 0
    for rows, columns in count:
        grid = [row_of[start + row * columns :][:columns] for row in range(rows)]
        turned = [list(each) for each in zip(*grid, strict=True)]
        for lines, kept in ((grid, along_rows), (turned, along_columns)):
            for line in lines[min(every, len(lines) - 1) // 2 :: every]:
                run: list[int] = []
                for vertex in [*line, -1]:
                    if vertex >= 0:
                        run.append(vertex)
                        continue
                    if len(run) > 1:
                        kept.append(run)
                    run = []
        start += rows * columns
    return along_rows + along_columns


def test_lines_follow_rows_and_columns_and_break_where_a_surface_is_trimmed() -> None:
    rng = np.random.default_rng(0)
    count = [(2, 2), (9, 5), (3, 14), (2, 6), (7, 8), (2, 2)]
    sizes = np.array([rows * columns for rows, columns in count])
    for share in (1.0, 0.8, 0.3, 0.0):
        kept = rng.random(sizes.sum()) < share
        row_of = np.where(kept, np.cumsum(kept) - 1, -1)
        lattices = Lattices(np.zeros((6, 2)), np.ones((6, 2)), np.array(count), np.cumsum(sizes) - sizes)
        rows, lengths = isolines(lattices, row_of, 4)
        lines = [each.tolist() for each in np.split(rows, np.cumsum(lengths)[:-1])] if lengths.size else []
        assert lines == traced(count, row_of.tolist(), 4)
        assert bool(lines) == (share > 0.0)


def test_each_line_runs_along_a_row_or_a_column_of_the_image() -> None:
    result = small_result()
    mesh = surface_mesh(result.tree, result.tree.labels("surfaces"), 3.0)
    assert mesh.isoline_sizes.size > 20
    for line in np.split(mesh.vertices_m[mesh.isolines], np.cumsum(mesh.isoline_sizes)[:-1]):
        # Parameters of a surface are pixels.
        extent_px = np.ptp(131.0 * line[:, :2] / line[:, 2:], axis=0)
        assert extent_px.min() < 0.5
        assert extent_px.max() > 2.0


def test_no_surface_has_no_lines() -> None:
    rows, lengths = isolines(Lattices.over([], 4.0), np.zeros(0, dtype=np.int64), 4)
    assert rows.size == lengths.size == 0
