"""Knows files that are not read by their first bytes or names, and says what to do with them."""

from collections.abc import Callable
from pathlib import Path

#: Bytes by which all of these are known.
HEAD_BYTES = 1024

_PLUG_IN = "or read it by a plug-in of the group nurbseg.sources, as examples/sources does"
_NYU = "a MATLAB file; of NYU Depth v2, nurbseg-eval reads nyu:{path}; export others as 16-bit PNG"
_PIXELS = "export 16-bit PNG, floating-point TIFF, or an array by numpy.save"
_LOSSY = "compressed with loss, which changes depth; export 16-bit PNG"
_IMAGES = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"BM", b"P5", b"P6")
_ARCHIVES = (b"PK\x03\x04", b"\x1f\x8b", b"\x28\xb5\x2f\xfd", b"BZh", b"\xfd7zXZ\0", b"7z\xbc\xaf", b"Rar!")
#: Files that are not read: how their name ends, else their first bytes, and what to do with them.
_FILES: tuple[tuple[tuple[str | bytes, ...], str], ...] = (
    ((".r3d",), "a recording of Record3D; pip install examples/sources, and open record3d:{path}"),
    (
        (".sens",),
        "a ScanNet recording; extract it by ScanNet's SensReader: python reader.py --filename {path} "
        "--output_path {stem} --export_depth_images --export_color_images --export_intrinsics",
    ),
    ((".klg",), "a log of Logger2 (ElasticFusion); convert it to a TUM RGB-D folder"),
    ((".xef",), "a recording of Kinect Studio; export its depth and color images"),
    (
        (".svo", ".svo2"),
        "a recording of a ZED; export depth by the SDK's sample SVO/export, as 16-bit PNG",
    ),
    ((".exr", ".pfm"), "not read; convert it to floating-point TIFF: oiiotool {path} -o {stem}.tiff"),
    ((".npz",), "an archive of NumPy arrays; save the one that is depth by numpy.save, as NAME_depth.npy"),
    ((".jpg", ".jpeg", ".webp", ".mp4", ".avi"), _LOSSY),
    ((".raw", ".bin"), f"raw pixels of no stated size; {_PIXELS}"),
    ((".mat", b"MATLAB "), _NYU),
    (
        (".h5", ".hdf5", b"\x89HDF"),
        f"an HDF5 file; {_PIXELS}; of NYU Depth v2, nurbseg-eval reads nyu:{{path}}",
    ),
    (
        (b"#ROSBAG V",),
        "a bag of ROS 1; convert it: rosbags-convert --src {path} --dst {stem} --dst-storage mcap",
    ),
    ((b"VRSf",), "a VRS recording; extract its images: vrs extract-images {path} --to {stem}"),
    ((b"RRF",), "a Rerun recording, which holds what was shown; look at it: rerun {path}"),
    ((b"\x1a\x45\xdf\xa3",), f"a Matroska recording, as of k4arecorder; extract its images, {_PLUG_IN}"),
    ((b"\x93NUMPY",), "a NumPy array; of depth, call it NAME_depth.npy and name its folder"),
    ((b"# .PCD", b"VERSION "), f"a PCD cloud; export its depth as 16-bit PNG, {_PLUG_IN}"),
    ((b"ply",), "a PLY cloud, which has no rows and columns; export the depth images"),
    ((b"\x80\x04",), "a Python pickle, which could run code; save its arrays by numpy.save instead"),
    (_ARCHIVES, "an archive or compressed; unpack it"),
)


def is_image(head: bytes) -> bool:
    """Whether a file is an image that can be decoded, by its first bytes."""
    return head.startswith(_IMAGES)


def stand_in(head: bytes) -> str | None:
    """Return what stands in place of a file, whatever was expected; None if nothing does."""
    text = head[:HEAD_BYTES].decode(errors="replace").lstrip("\ufeff \t\r\n").casefold()
    if text.startswith("version https://git-lfs"):
        return "a pointer of Git LFS, not the file itself; get it: git lfs pull"
    if text.startswith(("<!doctype html", "<html")):
        return "an HTML page, as a server sends in place of the file; download it again"
    return None


def what_it_is(head: bytes, path: Path) -> str | None:
    """Return what a file is, by its first bytes or its name, and what to do; None if unknown."""
    if (found := stand_in(head)) is not None:
        return found
    if is_image(head):
        return "one image; name the folder of a color and a depth image"
    return by_name(path) or _found(path, lambda mark: isinstance(mark, bytes) and head.startswith(mark))


def by_name(path: Path) -> str | None:
    """Return what a file of depth is by its name, and what to do; None if unknown."""
    return _found(path, lambda mark: mark == path.suffix.lower())


def _found(path: Path, is_mark: Callable[[str | bytes], bool]) -> str | None:
    """Return the text of the first file with such a mark, with the name in it; None if there is none."""
    text = next((text for marks, text in _FILES if any(map(is_mark, marks))), None)
    return text and text.replace("{path}", str(path)).replace("{stem}", path.stem)
