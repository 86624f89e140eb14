"""Files of other kinds are refused by name, with what turns them into one that can be read."""

from pathlib import Path

import pytest
from recorded_scene import scene, write_image, write_tum

from nurbseg.drivers import RecordingFormatError, SourceOptions, open_source

GIVEN = SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a21\nsize 12345\n"


OTHERS = [
    (
        "a.bag",
        b"#ROSBAG V1.2\n" + bytes(40),
        r"bag of ROS 1; convert it: rosbags-convert --src .*a\.bag --dst a ",
    ),
    ("a.db3", b"SQLite format 3\0" + bytes(40), "the ROS 2 database cannot be read"),
    ("a.mkv", b"\x1a\x45\xdf\xa3" + bytes(40), r"Matroska.*nurbseg\.sources"),
    ("a.r3d", b"PK\x03\x04" + bytes(40), r"Record3D; .* open record3d:.*a\.r3d"),
    ("a.pcd", b"# .PCD v0.7\nVERSION 0.7\n", r"PCD cloud; .*nurbseg\.sources"),
    ("a.mat", b"MATLAB 5.0 MAT-file" + bytes(200), r"nurbseg-eval reads nyu:.*a\.mat"),
    ("b.mat", b"MATLAB 7.3 MAT-file" + bytes(200), r"nurbseg-eval reads nyu:.*b\.mat"),
    ("a.zip", b"PK\x03\x04" + bytes(40), "an archive or compressed; unpack it"),
    ("a.tgz", b"\x1f\x8b\x08" + bytes(20), "an archive or compressed; unpack it"),
    ("a.SENS", b"\x04\0\0\0" + bytes(40), r"reader\.py --filename"),
    ("a.svo2", bytes(range(1, 256)), "a recording of a ZED; export"),
    ("a.vrs", b"VRSf" + bytes(40), "vrs extract-images"),
    ("a.exr", b"v/1\x01" + bytes(40), "oiiotool"),
    ("a.ply", b"ply\nformat ascii 1.0\n", "no rows and columns"),
    ("a.mp4", b"\0\0\0\x18ftypisom" + bytes(20), "compressed with loss"),
    ("a.rrd", b"RRF2" + bytes(20), r"rerun .*a\.rrd"),
    ("a.png", b"\x89PNG\r\n\x1a\n" + bytes(20), "one image; name the folder"),
    ("a.mcap", LFS, "git lfs pull"),
    ("a.oni", b"<!DOCTYPE html>\n<html>", "an HTML page"),
    ("b.mcap", b"\xef\xbb\xbf<html>", "an HTML page"),
    ("c.mcap", b"\x89MCAP0\r\n", r"c\.mcap: no topic.* the recording is cut off, perhaps before"),
    ("d.mcap", b"", r"d\.mcap: the file is empty; expected an MCAP"),
    ("e.mcap", b"hello\n", r"e\.mcap: not a recording of a known format; expected an MCAP"),
]
#: In a folder these are recordings, or images that its names do not pair.
READ_IN_FOLDERS = (".png", ".oni", ".mcap")


@pytest.mark.parametrize(("name", "content", "text"), OTHERS)
def test_a_file_of_another_kind_is_named_with_what_converts_it(tmp_path, name, content, text):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingFormatError, match=text):
        open_source(tmp_path / name, GIVEN)
    if not name.endswith(READ_IN_FOLDERS):
        with pytest.raises(RecordingFormatError, match=text):
            open_source(tmp_path, GIVEN)


def test_a_pointer_is_named_in_place_of_a_list_or_of_a_part_of_a_bag(tmp_path: Path) -> None:
    tum = write_tum(tmp_path / "tum", [scene(0)])
    (tum / "depth.txt").write_bytes(LFS)
    with pytest.raises(RecordingFormatError, match=r"depth\.txt: a pointer of Git LFS"):
        open_source(tum, GIVEN)
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths:\n    - bag_0.mcap\n"
    )
    (bag / "bag_0.mcap").write_bytes(LFS)
    with pytest.raises(RecordingFormatError, match=r"bag_0\.mcap: magic bytes: a pointer of Git LFS"):
        open_source(bag, GIVEN)


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        ("jpg", "compressed with loss, which changes depth"),
        ("exr", "oiiotool .*a_depth.exr"),
        ("npz", "numpy.save"),
        ("pfm", "oiiotool"),
        ("webp", "compressed with loss"),
        ("raw", "raw pixels"),
        ("mp4", "export 16-bit PNG"),
    ],
)
@pytest.mark.parametrize("place", ["a_depth.{}", "depth/a.{}"])
def test_depth_that_cannot_be_read_is_named_where_color_lacks_it(tmp_path, suffix, text, place):
    path = tmp_path / place.format(suffix)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"x")
    write_image(tmp_path / ("color/a.png" if path.parent != tmp_path else "a_color.png"), scene(0).color)
    with pytest.raises(
        RecordingFormatError, match=rf"{path.name}: cannot be read: .*{text.replace('a_depth', 'a.*')}"
    ):
        open_source(tmp_path, GIVEN)
