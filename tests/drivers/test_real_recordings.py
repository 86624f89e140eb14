"""Real recordings of several cameras and programs, where they are to be had."""

from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest

from nurbseg.drivers import SourceOptions, open_source
from nurbseg.drivers.datasets.pcd_file import read_pcd

Data = Callable[[str], Path]
PRIMESENSE = (525.0, 525.0, 319.5, 239.5)


@pytest.mark.parametrize(
    ("name", "options", "frames", "dropped", "labelled", "median_m"),
    [
        ("mosd_learn", SourceOptions(intrinsics=PRIMESENSE), 45, 0, True, (0.6, 1.0)),
        ("osd_background", SourceOptions(intrinsics=PRIMESENSE), 1, 0, False, (0.6, 1.0)),
        ("kitchen_sequence", SourceOptions(), 120, 0, False, (1.0, 2.5)),
        ("kitchen_tum", SourceOptions(intrinsics=(585, 585, 320, 240)), 57, 3, False, (1.0, 2.5)),
        ("tabletop_objects", SourceOptions(), 6, 0, False, (0.4, 0.7)),
        ("cape_calibrated_pair", SourceOptions(), 1, 0, False, (1.5, 2.5)),
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
    real_data: Data, name: str, options: SourceOptions, frames: int, dropped: int, labelled: bool, median_m
) -> None:
    with open_source(real_data(name), options) as source:
        read = list(source)
        assert source.metadata["dropped"] == str(dropped)
    assert len(read) == frames
    for frame in read:
        assert frame.depth_mm.shape == (480, 640)
        assert (frame.labels is not None) == labelled
        assert median_m[0] < np.median(frame.depth_mm[frame.depth_mm > 0]) / 1000 < median_m[1]
        assert frame.color.std() > 10


@pytest.mark.parametrize(
    ("name", "color", "depth_scale"), [("NYU", "ppm", None), ("SUN", "jpg", None), ("TUM", "png", 5000.0)]
)
def test_each_data_sets_own_form_of_depth_is_known(
    real_data: Data, name: str, color: str, depth_scale: float | None
) -> None:
    folder = real_data("open3d_formats")
    patterns = {"color": f"{folder}/{name}_color.{color}", "depth": f"{folder}/{name}_depth.p*"}
    options = SourceOptions(intrinsics=PRIMESENSE, depth_scale=depth_scale)
    with open_source(f"images:?{urlencode(patterns)}", options) as source:
        (frame,) = source
    assert 2 < np.median(frame.depth_mm[frame.depth_mm > 0]) / 1000 < 4


def test_tum_depth_is_the_depth_it_was_made_from(real_data: Data) -> None:
    options = SourceOptions(intrinsics=(585, 585, 320, 240))
    with open_source(real_data("kitchen_sequence")) as source:
        originals = {frame.depth_mm.tobytes(): frame.index for frame in source}
    with open_source(real_data("kitchen_tum"), options) as source:
        places = [originals[frame.depth_mm.tobytes()] for frame in source]
    assert places == sorted(places)


def test_organized_clouds_lie_on_a_primesense_cameras_rays(real_data: Data) -> None:
    with open_source(real_data("pcl_clouds")) as source:
        frames = list(source)
    assert len(frames) == 2
    for frame in frames:
        assert frame.calibration.depth.fx == pytest.approx(525, abs=1e-3)
        assert frame.calibration.depth.cy == pytest.approx(239.5, abs=1e-3)


def test_a_cloud_and_the_depth_image_it_was_made_from_agree(real_data: Data) -> None:
    folder = real_data("pcl_grabber")
    cloud = read_pcd(next(folder.glob("*.pcd")))
    with open_source(folder, SourceOptions(intrinsics=PRIMESENSE)) as source:
        frame = source.read()
    depth_mm = np.rint(np.nan_to_num(cloud.points_m[..., 2]) * 1000).astype(np.uint16)
    np.testing.assert_array_equal(depth_mm, frame.depth_mm)


def test_a_stereo_calibration_in_millimeters_takes_depth_points_to_color(real_data: Data) -> None:
    with open_source(real_data("cape_calibrated_pair")) as source:
        transform = source.calibration.color_from_depth
    np.testing.assert_allclose(transform[:3, 3], [0.0114975, 0.0351391, 0.0218875], atol=1e-6)
    assert transform[0, 1] == pytest.approx(-0.0111311, abs=1e-6)
