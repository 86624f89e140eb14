"""Results for Foxglove, by a WebSocket: images, points, boxes, transforms, and settings to change."""

import base64
import json
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.errors import PublishError
from nurbseg.app.export.objects import object_document
from nurbseg.app.publish.foxglove_socket import FoxgloveSocket
from nurbseg.app.publish.published import POINT, object_points, published_document
from nurbseg.app.publish.publisher import Sink
from nurbseg.library import palette
from nurbseg.library.boxes.boxes import OrientedBox
from nurbseg.library.objects import MeasuredObject
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.config import SegmentationConfig

_CAMERA, _SUPPORT = "camera", "support"
_JPEG_QUALITY = 85
#: Topics, with the SDK's class of their messages; without one, they are JSON.
_SCHEMAS = {
    "/color": "CompressedImage",
    "/depth": "RawImage",
    "/labels": "RawImage",
    "/calibration": "CameraCalibration",
    "/points": "PointCloud",
    "/objects": "SceneUpdate",
    "/tf": "FrameTransforms",
    "/results": "",
}
_TOPICS = list(_SCHEMAS)
#: Parameters in Foxglove, with the command that each is.
_COMMANDS = {"T": "ratio", "lambda": "lambda", "metric": "metric", "level": "level", "method": "method"}


class FoxgloveServer(Sink):
    """Publishes frames to everyone who opens `address` with Foxglove.

    Raises PublishError if a library is missing, or `host` and `port` cannot be used.
    """

    name = "Foxglove"

    def __init__(
        self, host: str, port: int, config: SegmentationConfig, ask: Callable[[str], object]
    ) -> None:
        try:
            import foxglove.messages

            self._messages: Any = foxglove.messages
            self._config = config
            self._ask = ask
            self._server = FoxgloveSocket(host, port, self._channels(), self._values, self._change)
        except ImportError as err:
            raise PublishError(
                "publishing to Foxglove needs foxglove-sdk and websockets: pip install 'nurbseg[foxglove]'"
            ) from err
        except OSError as err:
            reason = err.strerror or err
            raise PublishError(f"{host}:{port}: Foxglove's server cannot listen there: {reason}") from err
        self.address = self._server.address

    def configured(self, config: SegmentationConfig) -> None:
        """Tell listeners of settings that were changed."""
        self._config = config
        self._server.publish_parameters()

    def publish(self, result: FrameResult) -> None:
        """Publish a frame."""
        stamp_ns = result.frame.timestamp_ns
        stamp = self._messages.Timestamp(sec=stamp_ns // 10**9, nsec=stamp_ns % 10**9)
        common = {"timestamp": stamp, "frame_id": _CAMERA}
        contents = {
            _TOPICS.index(topic): message.encode()
            for topic, message in (*self._pictures(result, common), *self._space(result, common))
        }
        contents[_TOPICS.index("/results")] = json.dumps(published_document(result)).encode()
        self._server.publish(contents, stamp_ns)

    def close(self) -> None:
        """End the server."""
        self._server.close()

    def _channels(self) -> list[dict[str, Any]]:
        """Return the channels as the protocol advertises them, numbered as in `_TOPICS`."""
        channels = []
        for number, (topic, name) in enumerate(_SCHEMAS.items()):
            channel = {"id": number, "topic": topic, "encoding": "json", "schemaName": "", "schema": ""}
            if name:
                schema = getattr(self._messages, name).get_schema()
                content = base64.b64encode(schema.data).decode()
                channel |= {"encoding": "protobuf", "schemaName": schema.name, "schemaEncoding": "protobuf"}
                channel["schema"] = content
            channels.append(channel)
        return channels

    def _pictures(self, result: FrameResult, common: dict[str, Any]) -> Iterator[tuple[str, Any]]:
        """Yield the images, as the depth camera sees them, with its calibration."""
        m, camera = self._messages, result.frame.calibration.depth
        _, jpeg = cv2.imencode(
            ".jpg",
            cv2.cvtColor(result.cloud.color, cv2.COLOR_RGB2BGR),
            [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY],
        )
        yield "/color", m.CompressedImage(**common, format="jpeg", data=jpeg.tobytes())
        for topic, image in (("/depth", result.frame.depth_mm), ("/labels", result.labels())):
            yield (
                topic,
                m.RawImage(
                    **common,
                    width=camera.width,
                    height=camera.height,
                    encoding="16UC1",
                    step=2 * camera.width,
                    data=image.tobytes(),
                ),
            )
        matrix = camera.matrix
        yield (
            "/calibration",
            m.CameraCalibration(
                **common,
                width=camera.width,
                height=camera.height,
                distortion_model="rational_polynomial" if len(camera.distortion) > 5 else "plumb_bob",
                D=camera.distortion.tolist(),
                K=matrix.ravel().tolist(),
                R=np.eye(3).ravel().tolist(),
                P=np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
            ),
        )

    def _space(self, result: FrameResult, common: dict[str, Any]) -> Iterator[tuple[str, Any]]:
        """Yield the points, the boxes of objects, and where the support is."""
        m = self._messages
        points = object_points(result)
        kind = m.PackedElementFieldNumericType
        fields = [
            m.PackedElementField(name=axis, offset=4 * n, type=kind.Float32) for n, axis in enumerate("xyz")
        ]
        for n, name in enumerate(("blue", "green", "red", "alpha"), start=12):
            fields.append(m.PackedElementField(name=name, offset=n, type=kind.Uint8))
        fields.append(m.PackedElementField(name="label", offset=16, type=kind.Uint16))
        yield (
            "/points",
            m.PointCloud(
                **common,
                pose=_pose(m, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])),
                point_stride=POINT.itemsize,
                fields=fields,
                data=points.tobytes(),
            ),
        )
        every = m.SceneEntityDeletion(
            timestamp=common["timestamp"], type=m.SceneEntityDeletionType.All, id=""
        )
        entities = [self._entity(each, common) for each in result.objects]
        yield "/objects", m.SceneUpdate(deletions=[every], entities=entities)
        support = result.objects[0].support if result.objects else None
        if support is not None:
            camera_from_support = np.asarray(np.linalg.inv(support.support_from_camera), dtype=np.float64)
            center, axes = camera_from_support[:3, 3], camera_from_support[:3, :3].T
            turn = OrientedBox(center, axes, np.zeros(3)).quaternion
            transform = m.FrameTransform(
                timestamp=common["timestamp"],
                parent_frame_id=_CAMERA,
                child_frame_id=_SUPPORT,
                translation=_vector(m, center),
                rotation=_quaternion(m, turn),
            )
            yield "/tf", m.FrameTransforms(transforms=[transform])

    def _entity(self, each: MeasuredObject, common: dict[str, Any]) -> Any:
        m = self._messages
        red, green, blue = (part / 255 for part in palette.label_color(each.label))
        pose = _pose(m, each.box.center_m, each.box.quaternion)
        name = f"{each.label}{'' if each.is_sure else '?'}"
        return m.SceneEntity(
            **common,
            id=str(each.label),
            frame_locked=True,
            metadata=[m.KeyValuePair(key="object", value=json.dumps(object_document(each)))],
            cubes=[
                m.CubePrimitive(
                    pose=pose,
                    size=_vector(m, each.box.size_m),
                    color=m.Color(r=red, g=green, b=blue, a=0.5 if each.is_sure else 0.2),
                )
            ],
            texts=[
                m.TextPrimitive(
                    pose=pose,
                    billboard=True,
                    font_size=14.0,
                    scale_invariant=True,
                    color=m.Color(r=1.0, g=1.0, b=1.0, a=1.0),
                    text=name,
                )
            ],
        )

    def _values(self, names: list[str]) -> dict[str, Any]:
        """Return the settings that can be changed, those of some names or all."""
        values = {
            "T": float(self._config.ratio_max),
            "lambda": float(self._config.geometry_weight),
            "metric": self._config.metric,
            "level": self._config.extended.level,
            "method": self._config.method,
        }
        return {name: values[name] for name in names or values if name in values}

    def _change(self, name: str, value: Any) -> None:
        """Pass the change of a setting on to the run, which logs what is wrong with it."""
        if name in _COMMANDS:
            self._ask(f"{_COMMANDS[name]} {value}")


def _pose(messages: Any, place: NDArray[np.float64], turn: NDArray[np.float64]) -> Any:
    return messages.Pose(position=_vector(messages, place), orientation=_quaternion(messages, turn))


def _vector(messages: Any, values: NDArray[np.float64]) -> Any:
    x, y, z = values.tolist()
    return messages.Vector3(x=x, y=y, z=z)


def _quaternion(messages: Any, values: NDArray[np.float64]) -> Any:
    x, y, z, w = values.tolist()
    return messages.Quaternion(x=x, y=y, z=z, w=w)
