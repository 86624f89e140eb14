"""Messages as bytes and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum
from types import MappingProxyType

import numpy as np
import pytest
from numpy.typing import NDArray

from nurbseg.common.process.codec import Codec, aligned


class Color(StrEnum):
    RED = "r"


class Number(Enum):
    ONE = 1


@dataclass(frozen=True)
class Inner:
    name: str
    color: Color | None
    number: Number


@dataclass(frozen=True, eq=False)
class Outer:
    inner: tuple[Inner, ...]
    image: NDArray[np.uint16]
    other: NDArray[np.float32] | None
    values: Mapping[str, float]
    count: int = 3


def through(codec: Codec, message: object) -> object:
    text, arrays = codec.encode(message)
    body = b"".join(array.tobytes().ljust(aligned(array.nbytes), b"-") for array in arrays)
    return codec.decode(text, memoryview(body))


def test_what_is_encoded_is_decoded_again() -> None:
    image = np.arange(1500, dtype=np.uint16).reshape(3, 500)[:, ::2]
    inner = (Inner("ä\n", Color.RED, Number.ONE), Inner("", None, Number.ONE))
    values = MappingProxyType({"a": 0.1, "b": math.inf, "c": float(np.float32(0.3))})
    sent = Outer(inner, image, np.zeros((0, 3), np.float32), values, count=np.int64(2**40))  # type: ignore[arg-type]
    back = through(Codec(Outer), sent)
    assert isinstance(back, Outer)
    assert back.inner == inner
    assert type(back.inner[0].color) is Color
    np.testing.assert_array_equal(back.image, image)
    assert back.image.dtype == np.uint16
    assert back.other is not None
    assert (back.other.shape, back.other.dtype) == ((0, 3), np.float32)
    assert back.values == dict(values)
    assert back.count == 2**40


def test_arrays_of_a_message_do_not_change_with_the_memory_that_they_came_through() -> None:
    text, arrays = Codec(Outer).encode(Outer((), np.ones((200, 2), np.uint16), None, {}))
    body = bytearray(arrays[0].tobytes())
    back = Codec(Outer).decode(text, memoryview(body))
    body[:] = bytes(len(body))
    assert (back.image == 1).all()


def test_other_classes_are_not_decoded() -> None:
    text, _ = Codec(Inner).encode(Inner("a", None, Number.ONE))
    with pytest.raises(ValueError, match="no message is called 'Inner'"):
        Codec(Color).decode(text, memoryview(b""))


def test_other_values_are_not_encoded() -> None:
    with pytest.raises(TypeError, match="got object"):
        Codec().encode((1, object()))


def test_two_classes_of_one_name_are_refused() -> None:
    other = dataclass(type("Inner", (), {"__annotations__": {"x": "int"}}))
    with pytest.raises(ValueError, match="Inner: two classes have this name"):
        Codec(Inner, other)
