"""Boxes that are filtered over time, of objects whose motion is known."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.boxes.boxes import BoxEnds
from nurbseg.library.boxes.filtering import BoxStates, filtered

STEP_NS = 33_333_333
SIZE, LARGER = np.array([0.2, 0.1, 0.1]), np.array([0.4, 0.1, 0.1])


def box_at(center: NDArray[np.float64], size: NDArray[np.float64] = SIZE) -> BoxEnds:
    half = size / 2
    return BoxEnds(np.eye(3)[np.newaxis], (center - half)[None], (center + half)[None], np.array([0.5]))


def run(centers: NDArray[np.float64], sizes: dict[int, NDArray[np.float64]]) -> list[BoxStates]:
    """Filter a box that is measured at some centers, and has another size in some frames."""
    states, remembered = [], None
    for frame, center in enumerate(centers):
        box = box_at(center, sizes.get(frame, SIZE))
        state, remembered, _ = filtered(remembered, np.array([1]), box, frame * STEP_NS)
        states.append(state)
    return states


def test_what_moves_otherwise_than_before_is_followed_within_a_few_frames() -> None:
    seconds = np.arange(60) / 30
    rng = np.random.default_rng(1)
    # It stands for a second, and then begins to go around at .4 m/s.
    angle = 4.0 * np.maximum(seconds - 1.0, 0.0)
    true = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) + [0, 0, 1]
    states = run(true + rng.normal(0, 0.001, true.shape), {})
    off_m = np.array([np.linalg.norm(state.center[0] - at) for state, at in zip(states, true, strict=True)])
    assert off_m[:30].max() < 0.004
    # A filter that expects a steady velocity would be .1 m behind.
    assert off_m[30:].max() < 0.05 and np.median(off_m[38:]) < 0.025
    speed = np.linalg.norm(states[-1].velocity[0])
    assert 0.3 < speed < 0.5


def test_one_frame_that_differs_hardly_counts() -> None:
    rng = np.random.default_rng(1)
    centers = rng.normal((0, 0, 1), 0.001, (40, 3))
    centers[30] += [0.1, 0, 0]
    states = run(centers, {30: LARGER})
    for state in states[30:]:
        assert abs(state.center[0, 0]) < 0.006
        assert abs(state.size[0, 0] - SIZE[0]) < 0.006
    # A larger size that stays is taken over.
    states = run(centers, dict.fromkeys(range(30, 40), LARGER))
    assert states[-1].size[0, 0] > SIZE[0] + 0.1
