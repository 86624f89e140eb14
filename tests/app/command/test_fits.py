import numba
import pytest

from nurbseg.app.command import fits
from nurbseg.app.live.warmup import _frame
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.depth_grid import depth_grid
from nurbseg.segmentation.points.registration import register
from nurbseg.segmentation.surfaces import inverse_depth
from nurbseg.segmentation.surfaces.inverse_depth import fit_window


def test_fits_are_compiled_for_the_types_that_a_frame_has(monkeypatch: pytest.MonkeyPatch) -> None:
    types, fit = [], inverse_depth.fit_inverse_depth

    def spy(*arguments: object) -> object:
        types.append(tuple(numba.typeof(each) for each in arguments))
        return fit(*arguments)

    monkeypatch.setattr(fits, "fit_inverse_depth", spy)
    monkeypatch.setattr(inverse_depth, "fit_inverse_depth", spy)
    fits.main()
    grid = depth_grid(register(_frame(0)), 1)
    fit_window(grid, (0, 0, *grid.valid.shape), grid.valid, SegmentationConfig())
    assert len(types) == 2
    assert types[0] == types[1]
