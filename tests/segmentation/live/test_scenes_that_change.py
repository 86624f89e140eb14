"""Scenes in which one thing changes: it is found or gone soon, and all others stay what they are."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import product

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.common.settings import updated
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.tree import UpdateReport

CAMERA = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
SHAPE = (CAMERA.height, CAMERA.width)
FRAMES = 60
#: First frame of the change, and in how many frames after its end the scene is to be understood.
BEGIN, SOON = 20, 10
#: A thing of which fewer pixels are in view need not be found.
IN_VIEW_PX = 400
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Block:
    """A cuboid that stands on a base, meters; z is up."""

    name: str
    center: tuple[float, float]
    size: Vector
    color: Vector
    base: float = 0.0
    yaw: float = 0.0

    def world_from_block(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation and center."""
        cosine, sine = np.cos(np.deg2rad(self.yaw)), np.sin(np.deg2rad(self.yaw))
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return turn, np.array([*self.center, self.base + self.size[2] / 2])


@dataclass(frozen=True)
class View:
    """A camera that does not move, and what never changes before it."""

    eye: Vector
    target: Vector
    others: tuple[Block, ...]

    def axes(self) -> NDArray[np.float64]:
        """Directions of the camera's x, y and z as columns."""
        forward = np.subtract(self.target, self.eye)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.column_stack([right, np.cross(forward, right), forward])


TABLE = Block("table", (0.0, 0.0), (4.0, 4.0, 0.5), (150, 120, 90), base=-0.5)
WALL = Block("wall", (0.0, 1.0), (6.0, 0.1, 3.0), (175, 175, 165), base=-0.5)
CARTON = Block("carton", (-0.27, 0.14), (0.16, 0.1, 0.2), (190, 70, 50), yaw=25)
PACKET = Block("packet", (0.3, 0.06), (0.14, 0.18, 0.08), (60, 120, 90), yaw=-15)
TIN = Block("tin", (0.12, 0.36), (0.1, 0.1, 0.16), (70, 90, 170), yaw=40)
ON_TABLE = View((0.0, -0.72, 0.62), (0.0, 0.06, 0.06), (TABLE, WALL, CARTON, PACKET, TIN))
BEFORE_WALL = View(
    (0.12, 0.05, 0.32),
    (0.0, 0.95, 0.34),
    (TABLE, WALL, replace(CARTON, center=(-0.3, 0.78)), replace(PACKET, center=(0.26, 0.8))),
)

#: The thing that changes: where it is in each frame, if anywhere.
Course = Callable[[int], Block | None]
THING = Block("thing", (-0.02, 0.0), (0.13, 0.1, 0.12), (205, 165, 60), yaw=-20)
FLAT = Block("flat", (0.0, 0.94), (0.1, 0.02, 0.1), (165, 150, 175), base=0.33)


def step(frame: int, steps: int) -> float:
    """Share of a change that is done in a frame."""
    return min(1.0, max(0.0, (frame - BEGIN + 1) / steps))


def appears(frame: int) -> Block | None:
    """It is there at once."""
    return THING if frame >= BEGIN else None


def rises(frame: int) -> Block | None:
    """It rises by 38 mm out of the table."""
    return replace(THING, size=(0.13, 0.1, 0.038 * step(frame, 10))) if frame >= BEGIN else None


def hangs(frame: int) -> Block | None:
    """60x60 pixels are 20 mm before the wall."""
    return FLAT if frame >= BEGIN else None


def slides(frame: int) -> Block | None:
    """The same comes into view from the side."""
    return replace(FLAT, center=(1.0 - step(frame, 15), 0.94)) if frame >= BEGIN else None


def vanishes(frame: int) -> Block | None:
    """It is taken away."""
    return THING if frame < BEGIN else None


def moves(frame: int) -> Block | None:
    """It is pushed by 12 cm."""
    return replace(THING, center=(-0.08 + 0.12 * step(frame, 15), -0.02))


def is_stacked(frame: int) -> Block | None:
    """It is put on top of another."""
    on_packet = replace(THING, center=PACKET.center, size=(0.08, 0.08, 0.1), base=PACKET.size[2])
    return on_packet if frame >= BEGIN else None


def stays(frame: int) -> Block | None:
    """It is where it was."""
    return THING


def hand(frame: int) -> Block | None:
    """A hand that passes before it, near the camera."""
    across = 0.5 * step(frame, 20) - 0.25
    passing = Block("hand", (across, -0.42), (0.11, 0.04, 0.4), (215, 165, 145), base=0.12)
    return passing if 0.0 < step(frame, 20) < 1.0 else None


def arm(frame: int) -> Block | None:
    """An arm that passes before everything, and parts the table for a while."""
    across = 0.5 * step(frame, 20) - 0.25
    passing = Block("hand", (across, -0.5), (0.06, 0.04, 0.5), (215, 165, 145), base=0.1)
    return passing if 0.0 < step(frame, 20) < 1.0 else None


@dataclass(frozen=True)
class Change:
    """What happens, and the frame in which it is over."""

    view: View
    course: Course
    over: int
    #: What is between the thing and the camera meanwhile.
    before: Course = lambda frame: None


CHANGES = {
    "a thing appears": Change(ON_TABLE, appears, BEGIN),
    "a thing rises slowly out of the table": Change(ON_TABLE, rises, BEGIN + 9),
    "a flat thing appears before the wall": Change(BEFORE_WALL, hangs, BEGIN),
    "a flat thing comes into view along the wall": Change(BEFORE_WALL, slides, BEGIN + 14),
    "a thing is taken away": Change(ON_TABLE, vanishes, BEGIN),
    "a thing is pushed": Change(ON_TABLE, moves, BEGIN + 14),
    "a thing is put on another": Change(ON_TABLE, is_stacked, BEGIN),
    "a thing comes back from behind a hand": Change(ON_TABLE, stays, BEGIN + 19, hand),
    "a thing and the table come back from behind an arm": Change(ON_TABLE, stays, BEGIN + 19, arm),
}


@dataclass(frozen=True, eq=False)
class Picture:
    """Inverse depth, color and number of the block of each pixel, from 1 on; 0 is none."""

    inverse_depth: NDArray[np.float32]
    color: NDArray[np.float32]
    number: NDArray[np.intp]

    def copy(self) -> "Picture":
        """Return one that can be drawn in."""
        return Picture(self.inverse_depth.copy(), self.color.copy(), self.number.copy())


@lru_cache(maxsize=4)
def drawn(view: View, blocks: tuple[Block, ...], before: Picture | None = None) -> Picture:
    """Draw blocks, in front of a picture of others; in most frames they are where they were before."""
    empty = Picture(
        np.zeros(SHAPE, dtype=np.float32),
        np.zeros((*SHAPE, 3), dtype=np.float32),
        np.zeros(SHAPE, dtype=np.intp),
    )
    picture = (before or empty).copy()
    first = picture.number.max() + 1
    for number, block in enumerate(blocks, start=first):
        draw(picture, view, block, number)
    return picture


def draw(picture: Picture, view: View, block: Block, number: int) -> None:
    """Draw a block where it is in front: each ray is cut with the three pairs of its faces."""
    axes, (turn, center), half = view.axes(), block.world_from_block(), np.array(block.size) / 2
    corners = (np.array([*product(*zip(-half, half, strict=True))]) @ turn.T + center - view.eye) @ axes
    top, left, bottom, right = 0, 0, *SHAPE
    if corners[:, 2].min() > 0.05:
        places = corners[:, :2] / corners[:, 2:]
        (left, right), (top, bottom) = (
            (max(0, int(focal * each.min() + middle)), max(0, int(focal * each.max() + middle) + 2))
            for each, focal, middle in zip(
                places.T, (CAMERA.fx, CAMERA.fy), (CAMERA.cx, CAMERA.cy), strict=True
            )
        )
    window = slice(top, bottom), slice(left, right)
    inverse_depth = picture.inverse_depth[window]
    rows, columns = np.indices(inverse_depth.shape, dtype=np.float32)
    x, y = (columns + left - CAMERA.cx) / CAMERA.fx, (rows + top - CAMERA.cy) / CAMERA.fy
    directions = np.stack([x, y, np.ones_like(x)], axis=-1) @ (axes.T @ turn).astype(np.float32)
    origin = ((np.array(view.eye) - center) @ turn).astype(np.float32)
    extent = half.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(-extent - origin) / directions, (extent - origin) / directions])
        enters = ends.min(axis=0)
        near = enters.max(axis=-1)
        is_hit = (near > 0.05) & (near < ends.max(axis=0).min(axis=-1)) & (1 / near > inverse_depth)
    near = near[is_hit]
    pattern = np.sin((origin + near[:, np.newaxis] * directions[is_hit]) * 70).sum(axis=-1)
    light = np.array([0.75, 0.85, 1.0])[enters[is_hit].argmax(axis=-1)] * (1 + 0.05 * pattern)
    inverse_depth[is_hit] = 1 / near
    picture.color[window][is_hit] = light[:, np.newaxis] * block.color
    picture.number[window][is_hit] = number


@cache
def noise_and_grain(index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Noise of a frame's inverse depth, smooth over about a pixel and of deviation 1, and of its color."""
    rng = np.random.default_rng(index)
    noise = cv2.GaussianBlur(rng.standard_normal(SHAPE, dtype=np.float32), (0, 0), 1.0)
    return noise / noise.std(), rng.standard_normal(SHAPE, dtype=np.float32)[..., np.newaxis] * np.float32(2)


@pytest.fixture(scope="module", autouse=True)
def _memory() -> Iterator[None]:
    """Forget 150 MB when all scenes were seen."""
    yield
    noise_and_grain.cache_clear()
    drawn.cache_clear()


def measured(picture: Picture, index: int, noise_per_m: float) -> RGBDFrame:
    """A frame of a sensor whose noise is smooth over about a pixel."""
    noise, grain = noise_and_grain(index)
    noisy = picture.inverse_depth + noise * np.float32(noise_per_m)
    with np.errstate(divide="ignore"):
        depth_mm = np.where(noisy > 0.1, 1000 / noisy, 0)
    return RGBDFrame(
        index=index,
        timestamp_ns=index * 33_333_333,
        depth_mm=np.rint(depth_mm).astype(np.uint16),
        color=(picture.color + grain).clip(0, 255).astype(np.uint8),
        calibration=Calibration.registered(CAMERA),
    )


@dataclass(frozen=True)
class Seen:
    """What was found in a frame.

    The label that agrees best with the thing and how well, as an object and as a surface; the labels of all
    others by name, but for those that something hides for a moment; and what was done.
    """

    thing: int
    as_object: float
    as_surface: float
    others: dict[str, int]
    labels: frozenset[int]
    update: UpdateReport

    @property
    def overlap(self) -> float:
        """How well it was found; a thing with no side of its own to see may be merged with the wall."""
        return max(self.as_object, self.as_surface)


def watched(change: Change, noise_per_m: float) -> list[Seen]:
    """Segment the frames one after the other, and compare each with the truth."""
    # A noisier camera than the default is for has its setting.
    most = max(noise_per_m, SegmentationConfig().extended.inverse_depth_noise)
    config = updated(SegmentationConfig(), extended={"inverse_depth_noise": most})
    segmenter, seen, others = Segmenter(config), [], change.view.others
    unchanged = drawn(change.view, others)
    for frame in range(FRAMES):
        things = tuple(each for each in (change.course(frame), change.before(frame)) if each is not None)
        picture = drawn(change.view, things, unchanged)
        result = segmenter.process(measured(picture, frame, noise_per_m))
        update = result.update
        assert update is not None
        numbers = {each.name: n for n, each in enumerate((*others, *things), start=1)}
        hidden = {*unchanged.number[picture.number == numbers.get("hand", -1)]}
        sizes = np.bincount(picture.number.reshape(-1), minlength=len(numbers) + 1)
        in_view = {name: n for name, n in numbers.items() if n not in hidden and sizes[n] >= IN_VIEW_PX}
        objects, surfaces = (
            overlaps(picture.number, result.labels(level), sizes.size) for level in ("objects", "surfaces")
        )
        thing = next((in_view.pop(thing.name) for thing in things if thing.name in in_view), 0)
        in_view.pop("hand", None)
        best = objects.argmax(axis=1)
        labels = {name: int(best[n]) for name, n in in_view.items()}
        seen.append(
            Seen(
                int(best[thing]),
                float(objects[thing].max()),
                float(surfaces[thing].max()),
                labels,
                frozenset(result.object_labels),
                update,
            )
        )
    return seen


def overlaps(numbers: NDArray[np.intp], labels: NDArray[np.uint16], count: int) -> NDArray[np.float64]:
    """Intersection over union of each number with each label; 0 of either agrees with nothing."""
    width = int(labels.max()) + 1
    pairs = np.bincount((numbers * width + labels).reshape(-1), minlength=count * width)
    common = pairs.reshape(count, width)
    union = common.sum(axis=1, keepdims=True) + common.sum(axis=0) - common
    shares = common / np.maximum(union, 1)
    shares[0] = shares[:, 0] = 0.0
    return shares


@pytest.mark.parametrize("noise_per_m", [1e-3, 2.2e-3, 2.5e-3])
@pytest.mark.parametrize("name", CHANGES)
def test_what_changes_is_found_or_gone_and_others_stay(name: str, noise_per_m: float) -> None:
    change = CHANGES[name]
    seen = watched(change, noise_per_m)
    known, last = seen[BEGIN - 1], change.over + SOON
    # What is there and stays there is found, and has one label from then on.
    if change.course(FRAMES - 1) is not None:
        assert [n for n in range(last, FRAMES) if seen[n].overlap <= 0.5] == []
        labels = {each.thing for each in seen[last:]}
        assert len(labels) == 1
        if change.course(0) is not None:
            assert labels == {known.thing}
    else:
        assert known.as_object > 0.5
        assert [n for n in range(last, FRAMES) if known.thing in seen[n].labels] == []
    # All others are told apart from each other, and are the same from the frame before the change on.
    assert len({*known.others.values()}) == len(change.view.others)
    wrong = {
        n: {other: label for other, label in each.others.items() if label != known.others[other]}
        for n, each in enumerate(seen[BEGIN:], start=BEGIN)
    }
    assert {n: others for n, others in wrong.items() if others} == {}


def test_what_hides_a_thing_in_a_new_scene_does_not_get_its_label() -> None:
    hand = Block("hand", (-0.02, -0.36), (0.15, 0.04, 0.22), (215, 165, 145), base=0.17)
    unchanged = drawn(ON_TABLE, (*ON_TABLE.others, replace(THING, size=(0.15, 0.1, 0.14))))
    segmenter, labels, resets = Segmenter(), [], []
    for frame in range(9):
        picture = drawn(ON_TABLE, (hand,), unchanged) if 3 <= frame < 6 else unchanged
        result = segmenter.process(measured(picture, frame, 1e-3))
        best = overlaps(picture.number, result.labels("objects"), len(ON_TABLE.others) + 3).argmax(axis=1)
        labels.append(best[-2:].tolist())
        assert result.update is not None
        resets.append(bool(result.update.reset))
    assert resets == [True, False, False, True, False, False, True, False, False]
    (thing, _), (hidden, new) = labels[2:4]
    assert hidden != thing != new
    assert labels[6:] == [[thing, 0]] * 3


@pytest.mark.parametrize("light", [0.06, 0.25, 4.0])
def test_all_labels_stay_where_the_light_changes_at_once(light: float) -> None:
    picture = drawn(ON_TABLE, (*ON_TABLE.others, THING))
    lit = replace(picture, color=picture.color * np.float32(light))
    segmenter, labels = Segmenter(), []
    for frame in range(8):
        result = segmenter.process(measured(picture if frame < 3 else lit, frame, 1e-3))
        best = overlaps(picture.number, result.labels("objects"), len(ON_TABLE.others) + 2).argmax(axis=1)
        labels.append(best[1:].tolist())
    assert len({*labels[2]}) == len(ON_TABLE.others) + 1
    assert labels[3:] == [labels[2]] * 5
