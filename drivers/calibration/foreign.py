"""Knows files of other kinds by their first bytes or names, and says what makes them readable."""

import re
from pathlib import Path

#: Names that programs give to distances: Isaac Sim, AirSim, ifm's cameras, Taskonomy and Hypersim.
_DISTANCES = re.compile(
    r"distance_to_camera|radial_distance|depth_?perspective|depth_euclidean|frame\.\d{4}\.depth_meters",
    re.IGNORECASE,
)
#: What is wrong with these.
ALONG_RAYS = (
    "by its name the distance along each pixel's ray, not depth along the camera's axis; divide it by "
    "sqrt(((column - cx) / fx)^2 + ((row - cy) / fy)^2 + 1), and save it under another name"
)
#: Bytes by which all of these are known.
HEAD_BYTES = 1024

_LFS = "version https://git-lfs"
_ROSBAGS = "rosbags-convert --src {path} --dst {stem} --dst-storage mcap"
_ZED = "a recording of a ZED; export its depth by the SDK's sample SVO/export, as 16-bit PNG"
_IMAGES = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"BM", b"P5", b"P6")
#: The first bytes of files, what they are, and how they become one that can be read.
_MAGICS = (
    (b"#ROSBAG V", f"a bag of ROS 1; convert it: {_ROSBAGS}"),
    (b"VRSf", "a VRS recording; extract its images: vrs extract-images {path} --to {stem}"),
    (b"RRF", "a Rerun recording, which holds what was shown; look at it: rerun {path}"),
    (b"v/1\x01", "an OpenEXR image; convert it to floating-point TIFF: oiiotool {path} -o {stem}.tiff"),
    (b"\x93NUMPY", "a NumPy array; of depth, call it NAME_depth.npy and name its folder"),
    (b"ply", "a PLY cloud, which has no rows and columns; export the depth images or organized PCD clouds"),
    (b"\x1f\x8b", "compressed by gzip; unpack it: gunzip {path} (or tar -xzf {path})"),
    (b"\x28\xb5\x2f\xfd", "compressed by Zstandard; unpack it: zstd -d {path}"),
    (b"BZh", "compressed by bzip2; unpack it: bunzip2 {path} (or tar -xjf {path})"),
    (b"\xfd7zXZ\0", "compressed by xz; unpack it: unxz {path} (or tar -xJf {path})"),
    (b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive; unpack it: 7z x {path}"),
    (b"Rar!", "a RAR archive; unpack it: unrar x {path}"),
    (b"\x80\x04", "a Python pickle, which could run code; save its arrays by numpy.save instead"),
    (b"GIF8", "a GIF image, whose colors are a palette's; export PNG or TIFF"),
    (b"RIFF", "a RIFF file (AVI video, WebP image); export PNG or TIFF images"),
)
#: Kinds that are known by their names.
_SUFFIXES = {
    ".sens": "a ScanNet recording; extract it by ScanNet's SensReader: python reader.py --filename {path} "
    "--output_path {stem} --export_depth_images --export_color_images --export_intrinsics",
    ".klg": "a log of Logger2 (ElasticFusion); convert it to a TUM RGB-D folder",
    ".xef": "a recording of Kinect Studio; export its depth and color images",
    ".exr": "an OpenEXR image; convert it to floating-point TIFF: oiiotool {path} -o {stem}.tiff",
    ".svo": _ZED,
    ".svo2": _ZED,
    ".npz": "an archive of NumPy arrays; save the one that is depth alone, by its name: "
    "python -c \"import numpy; numpy.save('{stem}', numpy.load('{path}')['depth'])\"",
    ".jpg": "a JPEG, whose compression changes depth; export 16-bit PNG",
    ".jpeg": "a JPEG, whose compression changes depth; export 16-bit PNG",
    ".mp4": "a video, whose compression changes depth; export 16-bit PNG images",
    ".avi": "a video, whose compression changes depth; export 16-bit PNG images",
    ".mkv": "a video; export 16-bit PNG images",
    ".mat": "a MATLAB file; export 16-bit PNG images, or floating-point TIFF",
    ".pfm": "a PFM image; convert it to floating-point TIFF: oiiotool {path} -o {stem}.tiff",
    ".hdr": "a Radiance image; export 16-bit PNG, or floating-point TIFF",
    ".webp": "a WebP image of 8 bits; export 16-bit PNG",
    ".raw": "raw pixels of no stated size; export 16-bit PNG, or save them by numpy.save",
    ".bin": "raw pixels of no stated size; export 16-bit PNG, or save them by numpy.save",
    ".h5": "an HDF5 file; export 16-bit PNG, or save arrays by numpy.save",
    ".hdf5": "an HDF5 file; export 16-bit PNG, or save arrays by numpy.save",
}


def is_along_rays(name: str) -> bool:
    """Whether an image or topic has the distance along each pixel's ray, by its name."""
    return _DISTANCES.search(name) is not None


def is_image(head: bytes) -> bool:
    """Whether a file is an image that can be decoded, by its first bytes."""
    return head.startswith(_IMAGES)


def stand_in(head: bytes) -> str | None:
    """Return what a file is that stands in place of another, whatever was expected; None if it is none."""
    text = head[:HEAD_BYTES].decode(errors="replace").lstrip("\ufeff \t\r\n").casefold()
    if text.startswith(_LFS):
        return "a pointer of Git LFS, not the file itself; get it: git lfs pull"
    if text.startswith(("<!doctype html", "<html")):
        return "an HTML page, as a server sends in place of the file; download it again"
    return None


def what_it_is(head: bytes, path: Path) -> str | None:
    """Return what a file is, by its first bytes or its name, and how it is converted; None if unknown."""
    if (found := stand_in(head)) is not None:
        return found
    if is_image(head):
        return "one image; name the folder of a color and a depth image"
    return _filled(_by_content(head, path), path) or by_name(path)


def by_name(path: Path) -> str | None:
    """Return what a file of depth is by its name, and how it is converted; None if unknown."""
    return _filled(_SUFFIXES.get(path.suffix.lower()), path)


def _by_content(head: bytes, path: Path) -> str | None:
    if head.startswith(b"PK\x03\x04"):
        if path.suffix.lower() == ".npz":
            return None
        return "a zip archive; unpack it: unzip {path} -d {stem}"
    if head[257:262] == b"ustar":
        return "a tar archive; unpack it: tar -xf {path}"
    if head[4:8] == b"ftyp":
        return "an MP4 video, whose compression changes depth; export 16-bit PNG images"
    return next((text for magic, text in _MAGICS if head.startswith(magic)), None)


def _filled(text: str | None, path: Path) -> str | None:
    if text is None:
        return None
    return (
        text.replace("{path}", str(path)).replace("{parent}", str(path.parent)).replace("{stem}", path.stem)
    )
