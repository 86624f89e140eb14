"""The ground truth with the pieces of an object joined."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from nurbseg.evaluation.eval_command import main
from nurbseg.evaluation.truth import ground_truth


def beside(left: int, right: int, *, gap: int = 0, rows: int = 40, between: int = 0) -> np.ndarray:
    """Two regions of 20 columns and this many rows, with some columns of another label between them."""
    labels = np.zeros((60, 80), np.uint16)
    labels[:rows, :20] = left
    labels[:rows, 20 : 20 + gap] = between
    labels[:rows, 20 + gap : 40 + gap] = right
    return labels


# 12 columns of 11 on the first of 30 rows of 12: 7 x 12 = 84 pixels of 11 are near 12, and 182 of 12 near 11.
TIP = np.zeros((60, 80), np.uint16)
TIP[:30, 30:42] = 11
TIP[30:] = 12


# A column of each is 40 pixels, and with a gap of g columns 7 - g columns of a piece are near the other.
@pytest.mark.parametrize(
    ("labels", "regions"),
    [
        (beside(11, 12), {0, 11}),
        (beside(12, 11), {0, 11}),
        # Other objects, and two parts of the background.
        (beside(11, 21), {0, 11, 21}),
        (beside(1, 2), {0, 1, 2}),
        # 3 columns, 120 pixels, and then 2, 80 pixels.
        (beside(11, 12, gap=4), {0, 11}),
        (beside(11, 12, gap=5), {0, 11, 12}),
        # 7 columns of 15 rows are 105 pixels; of 14 rows, 98.
        (beside(11, 12, rows=15), {0, 11}),
        (beside(11, 12, rows=14), {0, 11, 12}),
        (TIP, {0, 11, 12}),
        # 3 columns of another object between 4 and 4 columns of the pieces; then 4 between 3 and 3.
        (beside(11, 12, gap=3, between=21), {0, 11, 21}),
        (beside(11, 12, gap=4, between=21), {0, 11, 12, 21}),
    ],
)
def test_pieces_of_one_object_that_meet_are_one_region(labels: np.ndarray, regions: set[int]) -> None:
    before = labels.copy()
    joined = ground_truth(labels, "joined")
    assert set(np.unique(joined).tolist()) == regions
    if regions >= {11, 12} or 12 not in labels:
        assert np.array_equal(joined, labels)
    else:
        assert np.array_equal(joined, np.where(labels == 12, 11, labels))
    assert np.array_equal(ground_truth(labels, "labels"), labels)
    assert np.array_equal(labels, before)


def test_pieces_that_meet_a_third_one_are_one_region_and_objects_may_have_other_labels() -> None:
    labels = np.repeat(np.array([12, 13, 11], np.uint16), 20)[None].repeat(40, axis=0)
    assert (ground_truth(labels, "joined") == 11).all()
    assert (ground_truth(labels, "joined", 100) == labels).all()
    assert (ground_truth(labels + 100, "joined", 100) == 111).all()
    assert (ground_truth(labels, "joined", 12) == np.where(labels == 13, 12, labels)).all()


@pytest.mark.parametrize(("folder", "changed"), [("mosd_learn", 10), ("mosd_clutter", 7)])
def test_few_frames_of_real_data_change(folder: str, changed: int) -> None:
    paths = list(Path(os.environ.get("NURBSEG_DATA", "")).glob(f"{folder}/*_label.png"))
    if not paths:
        pytest.skip("no data")
    images = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.uint16) for path in paths]
    assert sum(not np.array_equal(image, ground_truth(image, "joined")) for image in images) == changed


@pytest.fixture
def cut_frames(frames: Path) -> Path:
    """The frames with each box labeled as two pieces, and the boxes as label images."""
    (frames.parent / "theirs").mkdir()
    for path in frames.glob("*_label.png"):
        labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(frames.parent / "theirs" / path.name), labels)
        box = labels == 20
        labels[box & (np.arange(labels.shape[1]) >= np.nonzero(box)[1].min() + 20)] = 21
        cv2.imwrite(str(path), labels)
    return frames


def test_a_study_says_what_it_was_scored_against(cut_frames: Path, tmp_path: Path) -> None:
    words = ["run", str(cut_frames), "--methods", "", "--labels", str(tmp_path / "theirs"), "--frames", "2"]
    means = {}
    for truth in ("labels", "joined"):
        out = tmp_path / truth
        assert main([*words, "--time-frames", "0", "--truth", truth.upper(), "--out", str(out)]) == 0
        rows = [row.replace('"', "").split(",") for row in (out / "results.csv").read_text().splitlines()]
        columns = dict(zip(rows[0], zip(*rows[1:], strict=True), strict=True))
        assert set(columns["truth"]) == {truth}
        means[truth] = sum(map(float, columns["gtrc"])) / 2
        assert json.loads((out / "study.json").read_text())["truth"] == truth
        stated = "pieces of one object that meet in the image joined" if truth == "joined" else "as labeled"
        for name in ("report.html", "tables.md"):
            assert stated in (out / name).read_text()
    assert means["joined"] == 1.0
    # Each half is half of the box, and the box 1400 of the 6912 pixels.
    assert means["labels"] == pytest.approx(1 - 0.5 * 1400 / 6912)


def test_a_search_uses_the_joined_ground_truth(
    cut_frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    objectives = []
    for truth in ("labels", "joined"):
        words = ["tune", str(cut_frames), "--frames", "2", "--budget", "2", "--truth", truth]
        assert main([*words, "--out", str(tmp_path / f"{truth}.toml")]) == 0
        objectives.append(float(capsys.readouterr().out.partition("objective ")[2].split()[0]))
    assert objectives[1] > objectives[0] + 0.05
