"""Real recordings of several cameras and programs, where they are to be had."""

from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest

from nurbseg.drivers import RecordingFormatError, SourceOptions, open_source

Data = Callable[[str], Path]
PRIMESENSE = (525.0, 525.0, 319.5, 239.5)


def calibrated(folder: Path) -> SourceOptions:
    return SourceOptions(calibration=folder / "calib_params.xml")


@pytest.mark.parametrize(
    ("name", "options", "frames", "dropped", "labelled", "median_m"),
    [
        ("mosd_learn", SourceOptions(intrinsics=PRIMESENSE), 45, 0, True, (0.6, 1.0)),
        ("osd_background", SourceOptions(intrinsics=PRIMESENSE), 1, 0, False, (0.6, 1.0)),
        ("kitchen_sequence", SourceOptions(), 120, 0, False, (1.0, 2.5)),
        ("kitchen_tum", SourceOptions(intrinsics=(585, 585, 320, 240)), 57, 3, False, (1.0, 2.5)),
        ("tabletop_objects", SourceOptions(), 6, 0, False, (0.4, 0.7)),
        ("cape_calibrated_pair", None, 1, 0, False, (1.5, 2.5)),
        (
            "icl_planes",
            SourceOptions(intrinsics=(481.2, -480, 319.5, 239.5), depth_scale=5000),
            1,
            0,
            True,
            (2, 4),
        ),
        ("pcl_grabber", SourceOptions(intrinsics=PRIMESENSE), 3, 0, False, (0.7, 1.0)),
    ],
)
def test_a_folder_is_replayed_whole(
    real_data: Data,
    name: str,
    options: SourceOptions | None,
    frames: int,
    dropped: int,
    labelled: bool,
    median_m,
) -> None:
    with open_source(real_data(name), options or calibrated(real_data(name))) as source:
        read = list(source)
        assert source.metadata["dropped"] == str(dropped)
    assert len(read) == frames
    for frame in read:
        assert frame.depth_mm.shape == (480, 640)
        assert (frame.labels is not None) == labelled
        assert median_m[0] < np.median(frame.depth_mm[frame.depth_mm > 0]) / 1000 < median_m[1]
        assert frame.color.std() > 10


@pytest.mark.parametrize(
    ("name", "color", "refused", "depth_scale"),
    [
        # Low byte first, against PGM's rule, and of disparities; rotated by three bits.
        ("NYU", "ppm", "half of the depth is beyond 10 m", None),
        ("SUN", "jpg", "", 8000.0),
        ("TUM", "png", "half of the depth is beyond 10 m", 5000.0),
    ],
)
def test_depth_in_a_data_sets_own_unit_is_refused_until_it_is_stated(
    real_data: Data, name: str, color: str, refused: str, depth_scale: float | None
) -> None:
    folder = real_data("open3d_formats")
    uri = "images:?" + urlencode(
        {"color": f"{folder}/{name}_color.{color}", "depth": f"{folder}/{name}_depth.p*"}
    )
    with pytest.raises(RecordingFormatError, match=f"{refused}.*--depth-scale"):
        open_source(uri, SourceOptions(intrinsics=PRIMESENSE))
    if depth_scale is not None:
        with open_source(uri, SourceOptions(intrinsics=PRIMESENSE, depth_scale=depth_scale)) as source:
            (frame,) = source
        assert 2 < np.median(frame.depth_mm[frame.depth_mm > 0]) / 1000 < 4


def test_tum_depth_is_the_depth_it_was_made_from(real_data: Data) -> None:
    options = SourceOptions(intrinsics=(585, 585, 320, 240))
    with open_source(real_data("kitchen_sequence")) as source:
        originals = {frame.depth_mm.tobytes(): frame.index for frame in source}
    with open_source(real_data("kitchen_tum"), options) as source:
        places = [originals[frame.depth_mm.tobytes()] for frame in source]
    assert places == sorted(places)


def test_a_stereo_calibration_in_millimeters_takes_depth_points_to_color(real_data: Data) -> None:
    folder = real_data("cape_calibrated_pair")
    with open_source(folder, calibrated(folder)) as source:
        transform = source.calibration.color_from_depth
    np.testing.assert_allclose(transform[:3, 3], [0.0114975, 0.0351391, 0.0218875], atol=1e-6)
    assert transform[0, 1] == pytest.approx(-0.0111311, abs=1e-6)
