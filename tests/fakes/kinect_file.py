"""Recordings as k4arecorder writes them, made of scenes, by a writer of Matroska of its own."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import RGBDFrame

#: A calibration of a real Azure Kinect, as its owner published it, in parts of the sensors' sizes ...
DEPTH_PARAMETERS = [
    0.5122697949409485,
    0.49451231956481934,
    0.4921168386936188,
    0.4921667277812958,
    3.1305770874023438,
    2.324939012527466,
    0.1304156482219696,
    3.458651542663574,
    3.350114583969116,
    0.6629416346549988,
    0,
    0,
    -0.0000511557373101823,
    0.00008132171933539212,
]
COLOR_PARAMETERS = [
    0.4967627227306366,
    0.5108628273010254,
    0.470907062292099,
    0.6274453997612,
    0.7227460145950317,
    -2.8855903148651123,
    1.6327226161956787,
    0.6021990180015564,
    -2.7196261882781982,
    1.565053105354309,
    0,
    0,
    -0.0001431911950930953,
    0.0007828465895727277,
]
#: ... and what Microsoft's SDK made of it for depth of 640x576 and color of 1920x1080: fx, fy, cx, cy.
DEPTH_PRINTED = (503.927643, 503.978729, 332.064270, 325.880615)
COLOR_PRINTED = (904.141541, 903.521362, 953.284424, 555.142456)
#: Where the color camera sees the depth camera's points, meters.
ROTATION, TRANSLATION = cv2.Rodrigues(np.array([0.1, 0.0, 0.01]))[0], (-0.032, -0.002, 0.004)
#: The accelerometer looks along its x, and its z points down.
ACCELEROMETER_FROM_DEPTH = cv2.Rodrigues(np.array([0.1, 0.0, 0.0]))[0] @ [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
START_NS, DELAY_NS, SCALE_NS = 700_000_000, 160_000, 1000


def calibration(**changes: Any) -> dict[str, Any]:
    """Return the table of a calibration; `changes` are of the color camera."""

    def camera(place: str, parameters: list[float], size: tuple[int, int], pose: Any) -> dict[str, Any]:
        lens = {
            "ModelParameterCount": 14,
            "ModelParameters": parameters,
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
        }
        rotation, translation = pose
        return {
            "Intrinsics": lens,
            "Location": f"CALIBRATION_CameraLocation{place}",
            "MetricRadius": 1.7,
            "Rt": {"Rotation": np.ravel(rotation).tolist(), "Translation": list(translation)},
            "SensorWidth": size[0],
            "SensorHeight": size[1],
        }

    depth = camera("D0", DEPTH_PARAMETERS, (1024, 1024), (np.eye(3), (0, 0, 0)))
    color = camera("PV0", COLOR_PARAMETERS, (4096, 3072), (ROTATION, TRANSLATION)) | changes
    turned = {"Rotation": np.ravel(ACCELEROMETER_FROM_DEPTH).tolist(), "Translation": [0, 0, 0]}
    sensors = [
        {"SensorType": f"CALIBRATION_InertialSensorType_{name}", "Rt": pose}
        for name, pose in (
            ("Gyro", {"Rotation": [1] * 9, "Translation": [0, 0, 0]}),
            ("Accelerometer", turned),
        )
    ]
    return {"CalibrationInformation": {"Cameras": [depth, color], "InertialSensors": sensors}}


def element(kind: int, *contents: bytes, size: int | None = None) -> bytes:
    """Return an element, whose size is that of its contents if none is stated; -1 states none."""
    content = b"".join(contents)
    head = kind.to_bytes((kind.bit_length() + 7) // 8)
    stated = (1 << 56) - 1 if size == -1 else len(content) if size is None else size
    return head + (stated | 1 << 56).to_bytes(8) + content


def number(kind: int, value: int) -> bytes:
    return element(kind, value.to_bytes(max(1, (value.bit_length() + 7) // 8)))


def track(index: int, name: str, form: bytes, size: tuple[int, int], *more: bytes) -> bytes:
    """Return an entry of the list of tracks."""
    bitmap = struct.pack(
        "<IiiHH4sIiiII", 40, *(min(each, 99_999) for each in size), 1, 16, form, 0, 0, 0, 0, 0
    )
    video = element(0xE0, number(0xB0, size[0]), number(0xBA, size[1]))
    texts = element(0x536E, name.encode()), element(0x86, b"V_MS/VFW/FOURCC"), element(0x63A2, bitmap)
    return element(
        0xAE, number(0xD7, index), number(0x73C5, 1000 + index), number(0x83, 1), *texts, video, *more
    )


def tags(**stated: Any) -> bytes:
    simple = (
        element(0x67C8, element(0x45A3, name.encode()), element(0x4487, str(value).encode()))
        for name, value in stated.items()
    )
    return element(0x1254C367, *(element(0x7373, element(0x63C0), each) for each in simple))


def block(index: int, time: int, content: bytes, flags: int = 0x80) -> bytes:
    """Return an image at a time after its cluster's."""
    return element(0xA3, bytes([0x80 | index]), struct.pack(">hB", time, flags), content)


def readings(time_ns: int, down: NDArray[np.float64], count: int = 3) -> bytes:
    """Return a block of readings at rest, laced by EBML, with `down` in the depth camera's axes."""
    upward = -9.81 * ACCELEROMETER_FROM_DEPTH @ down
    noise = np.linspace(-0.3, 0.3, count)
    samples = [
        struct.pack("<Q3fQ3f", time_ns + n, *(upward + noise[n]), time_ns, 1, 2, 3) for n in range(count)
    ]
    lacing = bytes([count - 1, 0x80 | len(samples[0]), *[0xBF] * (count - 2)])
    return element(0xA0, element(0xA1, b"\x84\0\0\x06", lacing, *samples), number(0x9B, 5))


def jpeg(color: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def parts(
    frames: list[RGBDFrame], *, color_form: bytes = b"MJPG", table: dict[str, Any] | None = None
) -> dict[str, bytes]:
    """Return the parts of a file in their order; a part may be replaced, or left out.

    Frames that know where down is have readings of the accelerometer.
    """
    first = frames[0]
    depth_size, color_size = (
        (first.depth_mm.shape[1], first.depth_mm.shape[0]),
        (first.color.shape[1], first.color.shape[0]),
    )
    stated = json.dumps(calibration() if table is None else table).encode()
    kind = element(0x466E, b"calibration.json"), element(0x4660, b"application/octet-stream")
    file = element(0x61A7, *kind, element(0x465C, stated), number(0x46AE, 7))
    found = {
        "head": element(0x1A45DFA3, element(0x4282, b"matroska")),
        "segment": element(0x18538067, size=-1),
        "seek": element(0x114D9B74, bytes(30)) + element(0xEC, bytes(100)),
        "info": element(0x1549A966, number(0x2AD7B1, SCALE_NS), element(0x7BA9, b"Azure Kinect")),
        "tracks": element(
            0x1654AE6B,
            track(1, "COLOR", color_form, color_size),
            track(2, "DEPTH", b"b16g", depth_size),
            track(3, "IR", b"b16g", depth_size),
            track(4, "IMU", b"IMU\0", (0, 0)),
        ),
        "attachments": element(0x1941A469, file),
        "tags": tags(
            K4A_DEPTH_DELAY_NS=DELAY_NS,
            K4A_DEVICE_SERIAL_NUMBER="000123",
            K4A_START_OFFSET_NS=START_NS,
            K4A_DEPTH_MODE="NFOV_UNBINNED",
        ),
    }
    for frame in frames:
        if color_form == b"MJPG":
            color = jpeg(frame.color)
        elif color_form == b"BGRA":
            color = np.dstack(
                [frame.color[..., ::-1], np.full(frame.color.shape[:2], 255, np.uint8)]
            ).tobytes()
        elif color_form == b"YUY2":
            color = cv2.cvtColor(frame.color, cv2.COLOR_RGB2YUV_YUY2).tobytes()
        else:
            planar = cv2.cvtColor(frame.color, cv2.COLOR_RGB2YUV_I420).reshape(-1)
            luma, rest = planar[: frame.color[..., 0].size], planar[frame.color[..., 0].size :]
            color = np.concatenate([luma, rest.reshape(2, -1).T.reshape(-1)]).tobytes()
        depth = frame.depth_mm.astype(">u2").tobytes()
        if frame.gravity is None:
            imu = element(0xA0, element(0xA1, b"\x84\0\0\x06", bytes(60)), number(0x9B, 5))
        else:
            imu = readings(frame.timestamp_ns, frame.gravity)
        found[f"cluster{frame.index}"] = element(
            0x1F43B675,
            element(0xBF, bytes(4)),
            number(0xE7, 33_333 * frame.index),
            block(1, 0, color),
            block(3, DELAY_NS // SCALE_NS, bytes(len(depth))),
            block(2, DELAY_NS // SCALE_NS, depth),
            imu,
        )
    return found | {"cues": element(0x1C53BB6B, bytes(20))}


def write_mkv(path: Path, frames: list[RGBDFrame], **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(parts(frames, **options).values()))
    return path


def kinect_frames(
    count: int, depth_size: tuple[int, int] = (320, 288), color_size: tuple[int, int] = (1280, 720)
) -> list[RGBDFrame]:
    """Return frames of modes that a Kinect has, whose calibration is none of its."""
    from nurbseg.common.frame import Calibration, Intrinsics

    any_of = [Intrinsics(*size, 500.0, 500.0, size[0] / 2, size[1] / 2) for size in (depth_size, color_size)]
    v, u = np.mgrid[: depth_size[1], : depth_size[0]]
    rows, columns = np.mgrid[: color_size[1], : color_size[0]]
    frames = []
    for index in range(count):
        depth_mm = (1000 + 5 * u + 3 * v + index).astype(np.uint16)
        depth_mm[(u + v) % 17 == 0] = 0
        color = np.stack([columns // 8, rows // 8, (columns + rows) // 16 + index], axis=-1).astype(np.uint8)
        frames.append(RGBDFrame(index, index * 33_333_000, depth_mm, color, Calibration(*any_of)))
    return frames
