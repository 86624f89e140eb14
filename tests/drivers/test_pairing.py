"""Pairs of depth and color messages, as they come and at the end."""

import pytest

from nurbseg.drivers.mcap.pairing import Kind, StampPairing


def paired(*messages: tuple[Kind, int], limit: int = 20, at_end: bool = False) -> tuple[list[str], int]:
    """Return the contents of the pairs of messages, and how many messages were dropped."""
    pairing, pairs = StampPairing(limit), []
    for kind, stamp_ns in messages:
        pairing.add(kind, stamp_ns, f"{kind[0]}{stamp_ns}".encode())
        while pair := pairing.take():
            pairs.append(pair)
    while at_end and (pair := pairing.take(at_end=True)):
        pairs.append(pair)
    # What is left is counted once.
    assert pairing.take(at_end=at_end) is None
    texts = [b" ".join([pair.depth, pair.color or b"-", pair.labels or b"-"]).decode() for pair in pairs]
    assert [f"d{pair.stamp_ns}" for pair in pairs] == [text.split()[0] for text in texts]
    return texts, pairing.dropped


def test_equal_stamps_are_paired_at_once_and_what_came_before_is_dropped() -> None:
    assert paired(("depth", 100), ("color", 100)) == (["d100 c100 -"], 0)
    assert paired(("color", 0), ("color", 30), ("color", 100), ("depth", 100)) == (["d100 c100 -"], 2)
    # A nearer color image may follow.
    assert paired(("depth", 100), ("color", 90)) == ([], 0)


def test_labels_are_those_of_the_same_stamp() -> None:
    both = [(kind, stamp) for stamp in (100, 200) for kind in ("depth", "color")]
    assert paired(("labels", 90), ("labels", 200), *both)[0] == ["d100 c100 -", "d200 c200 l200"]
    assert paired(("labels", 100), ("labels", 200), *both)[0] == ["d100 c100 l100", "d200 c200 l200"]


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize(("late", "expected"), [(0, 20), (1, 20), (15, 20), (16, 0), (None, 0)])
def test_labels_that_are_logged_later_are_waited_for(color: bool, late: int | None, expected: int) -> None:
    pairing, pairs = StampPairing(20, color=color, labels=True), []
    for number in range(20 + (late or 0)):
        kinds: list[tuple[Kind, int]] = [("depth", number), ("color", number)][: 1 + color]
        kinds += [] if late is None or number < late else [("labels", number - late)]
        for kind, each in kinds:
            if each < 20 and (kind == "labels" or number < 20):
                pairing.add(kind, 100 * each, f"{kind} {each}".encode())
                while pair := pairing.take():
                    pairs.append(pair)
    while pair := pairing.take(at_end=True):
        pairs.append(pair)
    assert [pair.stamp_ns // 100 for pair in pairs] == list(range(20)) and pairing.dropped == 0
    found = [number for number, pair in enumerate(pairs) if pair.labels == f"labels {number}".encode()]
    assert len(found) == expected or (late == 16 and found == list(range(20 - len(found), 20)))
    assert pairing.unused_labels == (0 if late is None else 20 - len(found))


@pytest.mark.parametrize(
    ("colors", "depths", "pairs", "dropped"),
    [
        # The nearer of two colors, and of two depths; the others have no partner.
        ((90, 104), (100, 140), ["d100 c104 -"], 1),
        ((108, 150), (100, 110, 150), ["d110 c108 -", "d150 c150 -"], 1),
        # One later than the limit.
        ((121, 200), (100, 200), ["d200 c200 -"], 2),
        ((120, 200), (100, 200), ["d100 c120 -", "d200 c200 -"], 0),
    ],
)
def test_the_nearest_within_the_limit_are_paired_once_that_is_certain(
    colors: tuple[int, ...], depths: tuple[int, ...], pairs: list[str], dropped: int
) -> None:
    found = paired(*(("color", color) for color in colors), *(("depth", depth) for depth in depths))
    assert found == (pairs, dropped)


def test_at_the_end_nothing_is_waited_for() -> None:
    messages: list[tuple[Kind, int]] = [("depth", 100), ("color", 90), ("depth", 180)]
    assert paired(*messages, at_end=True) == (["d100 c90 -"], 1)
    assert paired(*messages, ("color", 260), ("color", 290), at_end=True) == (["d100 c90 -"], 3)
    assert paired(("color", 90), ("color", 120), at_end=True) == ([], 2)


def test_images_from_before_the_clock_was_set_back_do_not_wait_for_the_old_time() -> None:
    before: list[tuple[Kind, int]] = [("depth", 1000), ("color", 996)]
    after: list[tuple[Kind, int]] = [("depth", 100), ("color", 96), ("depth", 140), ("color", 136)]
    assert paired(*before, *after)[0] == ["d1000 c996 -", "d100 c96 -"]
    assert paired(*before, *after, at_end=True) == (["d1000 c996 -", "d100 c96 -", "d140 c136 -"], 0)


def test_without_color_each_depth_image_is_a_pair() -> None:
    pairing = StampPairing(20, color=False)
    pairing.add("labels", 100, b"l")
    pairing.add("depth", 100, b"d", 7)
    pair = pairing.take()
    assert pair is not None
    assert (pair.depth, pair.color, pair.labels, pair.number) == (b"d", None, b"l", 7)
    assert pairing.take(at_end=True) is None
    assert pairing.dropped == 0


def test_at_most_64_messages_wait_for_their_partners() -> None:
    waiting: list[tuple[Kind, int]] = [("depth", n) for n in range(64)]
    assert paired(*waiting, limit=0) == ([], 0)
    assert paired(*waiting, ("depth", 64), ("color", 0), limit=0)[1] >= 1
    assert paired(*waiting, ("depth", 64), ("color", 1), limit=0)[0] == ["d1 c1 -"]
