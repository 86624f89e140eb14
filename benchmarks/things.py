"""How well pieces of objects that others cut apart are put together: precision, recall, and scores of things.

The ground truth has the number of the object in ``label // 10``, 0 for the table, and that of the piece in
``label % 10``. Pairs of pieces are counted with the table and without it.

Examples
--------
As in docs/accuracy.md::

    python benchmarks/things.py mosd_learn mosd_clutter --intrinsics 525,525,319.5,239.5
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
from ablation import Frames, registered
from labelled import frames_parser, labelled_frames
from numpy.typing import NDArray

from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.segments import SegmentationTree


def joined_pairs(tree: SegmentationTree, truth: NDArray[np.integer], first: int) -> list[int]:
    """Count pairs of pieces that do not meet: of one thing and object, of one thing, and of one object.

    Objects of the ground truth count from the number `first` on.

    A piece counts as of the object that most of its labeled pixels are of.
    """
    image, leaves = tree.labels("surfaces"), [leaf.name for leaf in tree.leaves()]
    # Pieces are what things consist of: the groups that contacts merge.
    group = {name: {name} for name in leaves}
    for contact in tree.contacts:
        if contact.merged:
            both = group[contact.first] | group[contact.second]
            group.update(dict.fromkeys(both, both))
    pieces = sorted({min(each): sorted(each) for each in group.values()}.values())
    piece_of = {name: number for number, names in enumerate(pieces) for name in names}
    number = np.array([-1, *(piece_of[name] for name in leaves)])[image]
    objects = []
    for piece in range(len(pieces)):
        labels = truth[(number == piece) & (truth > 0)] // 10
        objects.append(int(np.bincount(labels).argmax()) if labels.size else -1 - piece)
    meet = {frozenset((piece_of[contact.first], piece_of[contact.second])) for contact in tree.contacts}
    thing_of = {name: n for n, each in enumerate(tree.objects) for name in each.leaves}
    things = [thing_of[names[0]] for names in pieces]
    counts = np.zeros(3, dtype=int)
    for one, other in combinations(range(len(pieces)), 2):
        if frozenset((one, other)) not in meet and max(objects[one], objects[other]) >= first:
            together, same = things[one] == things[other], objects[one] == objects[other]
            counts += (together and same, together, same)
    return list(counts.tolist())


def measured(frames: Frames, seed: int) -> NDArray[np.float64]:
    """Count and score every frame: (frames, 10)."""
    rows = []
    for cloud, truth in frames:
        whole = np.where(truth > 0, truth // 10 + 1, 0)
        scores = []
        for level in ("objects", "things"):
            tree = segment(cloud, SegmentationConfig(seed=seed, extended=ExtendedConfig(level=level)))
            table = Contingency.between(tree.labels(), whole)
            scores += [table.region_covering(), table.variation_of_information()]
        rows.append([*joined_pairs(tree, truth, 0), *joined_pairs(tree, truth, 1), *scores])
    return np.array(rows)


def main() -> None:
    """Run from the command line."""
    given = frames_parser(__doc__, "folders of pairs or recordings with labeled pieces").parse_args()
    print(
        "| frames | pairs joined | precision | recall | not of the table | precision | recall "
        "| objects: GTRC | VoI | things: GTRC | VoI |"
    )
    print("|---" * 11 + "|")
    for path in given.frames:
        frames = registered(labelled_frames(path, given))
        rows = [measured(frames, seed) for seed in range(given.seeds)]
        counts = " | ".join(
            f"{joined:.0f} | {right / max(1, joined):.3f} | {right / max(1, possible):.2f}"
            for right, joined, possible in np.sum(rows, axis=(0, 1))[:6].reshape(2, 3)
        )
        scores = " | ".join(f"{each:.4f}" for each in np.mean(rows, axis=(0, 1))[6:])
        print(f"| {Path(path).name} | {counts} | {scores} |", flush=True)


if __name__ == "__main__":
    main()
