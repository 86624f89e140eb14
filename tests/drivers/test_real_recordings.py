"""Real recordings of several cameras and programs, where they are to be had."""

import numpy as np
import pytest

from nurbseg.drivers import SourceOptions, open_source

PRIMESENSE = (525.0, 525.0, 319.5, 239.5)


@pytest.mark.parametrize(
    ("name", "options", "frames", "dropped", "labelled", "median_m"),
    [
        ("mosd_learn", {"intrinsics": PRIMESENSE}, 45, 0, True, (0.6, 1.0)),
        ("osd_background", {"intrinsics": PRIMESENSE}, 1, 0, False, (0.6, 1.0)),
        ("kitchen_sequence", {}, 120, 0, False, (1.0, 2.5)),
        ("kitchen_tum", {"intrinsics": (585, 585, 320, 240)}, 57, 3, False, (1.0, 2.5)),
        ("tabletop_objects", {}, 6, 0, False, (0.4, 0.7)),
        ("cape_calibrated_pair", {"calibration": "calib_params.xml"}, 1, 0, False, (1.5, 2.5)),
        ("icl_planes", {"intrinsics": (481.2, -480, 319.5, 239.5), "depth_scale": 5000}, 1, 0, True, (2, 4)),
        ("pcl_grabber", {"intrinsics": PRIMESENSE}, 3, 0, False, (0.7, 1.0)),
    ],
)
def test_a_folder_is_replayed_whole(real_data, name, options, frames, dropped, labelled, median_m):
    folder = real_data(name)
    given = {key: folder / value if key == "calibration" else value for key, value in options.items()}
    with open_source(folder, SourceOptions(**given)) as source:
        read = list(source)
        assert source.metadata["dropped"] == str(dropped)
    assert len(read) == frames
    for frame in read:
        assert frame.depth_mm.shape == (480, 640)
        assert (frame.labels is not None) == labelled
        assert median_m[0] < np.median(frame.depth_mm[frame.depth_mm > 0]) / 1000 < median_m[1]
        assert frame.color.std() > 10
