"""The files of corrected frames, as the data reader, the evaluation and COCO's own library read them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_scene import small_frame, small_result

from nurbseg import Annotation, open_source
from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.evaluation.methods.methods import labels_on_disk
from nurbseg.library.result import FrameResult


def corrected(result: FrameResult) -> Annotation:
    annotation = Annotation(result)
    annotation.split(annotation.objects[0])
    return annotation


def test_a_saved_frame_is_replayed_with_its_labels(tmp_path: Path) -> None:
    first, second = corrected(small_result(0)), corrected(small_result(3))
    assert first.save(tmp_path / "new" / "labels") == tmp_path / "new" / "labels" / "small0_label.png"
    second.save(tmp_path / "new" / "labels")
    with open_source(str(tmp_path / "new" / "labels")) as source:
        frames = list(source)
    assert [frame.name for frame in frames] == ["small0", "small3"]
    for frame, annotation in zip(frames, (first, second), strict=True):
        given = annotation.result.frame
        assert np.array_equal(frame.depth_mm, given.depth_mm)
        assert np.array_equal(frame.color, given.color)
        assert frame.labels is not None
        assert np.array_equal(frame.labels, annotation.labels)
        assert frame.calibration.equals(given.calibration)


def test_the_evaluation_finds_the_labels_of_another_program_there(tmp_path: Path) -> None:
    annotation = corrected(small_result())
    annotation.save(tmp_path)
    frame = annotation.result.frame
    found = labels_on_disk(tmp_path, frame.name, frame.index, frame.depth_mm.shape)
    assert np.array_equal(found, annotation.labels)


def test_the_camera_is_the_depth_camera_with_its_distortion(tmp_path: Path) -> None:
    depth = Intrinsics(160, 120, 131.0, 132.0, 79.0, 59.0, np.array([0.01, -0.02, 0.001, 0.0, 0.003]))
    color = Intrinsics(160, 120, 140.0, 140.0, 80.0, 60.0)
    apart = np.eye(4)
    apart[0, 3] = 0.02
    result = small_result(calibration=Calibration(depth, color, apart))
    Annotation(result).save(tmp_path)
    with open_source(str(tmp_path)) as source:
        frame = source.read()
    assert frame.calibration.is_registered
    assert frame.calibration.depth.equals(depth)
    assert np.array_equal(frame.color, result.cloud.color)


def test_a_frame_without_a_name_is_called_by_its_number(tmp_path: Path) -> None:
    result = small_result()
    plain = replace(result, frame=replace(result.frame, name="", index=12))
    assert Annotation(plain).save(tmp_path).name == "000012_label.png"
    odd = replace(result, frame=replace(result.frame, name="../a b"))
    assert Annotation(odd).save(tmp_path) == tmp_path / ".._a_b_label.png"


# Its compiled part converts arrays as before NumPy 2.
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_coco_s_library_reads_the_same_masks(tmp_path: Path) -> None:
    from pycocotools.coco import COCO

    saved = {each.result.frame.name: each for each in map(corrected, (small_result(0), small_result(3)))}
    for each in saved.values():
        each.save(tmp_path)
    # Again with other labels: those replace the first.
    saved["small0"].undo()
    saved["small0"].save(tmp_path)
    coco = COCO(str(tmp_path / "annotations.json"))
    images = coco.loadImgs(coco.getImgIds())
    assert len(coco.dataset["images"]) == 2
    assert sorted(image["file_name"] for image in images) == ["small0_color.png", "small3_color.png"]
    for image in images:
        photo = cv2.imread(str(tmp_path / image["file_name"]))
        assert photo is not None
        assert photo.shape[:2] == (image["height"], image["width"])
        labels = saved[image["file_name"].partition("_")[0]].labels
        found = np.zeros_like(labels)
        annotations = coco.loadAnns(coco.getAnnIds(imgIds=[image["id"]], catIds=coco.getCatIds()))
        for annotation in annotations:
            mask = coco.annToMask(annotation) > 0
            rows, columns = np.nonzero(mask)
            left, top, width, height = annotation["bbox"]
            assert (left, top) == (columns.min(), rows.min())
            assert (left + width, top + height) == (columns.max() + 1, rows.max() + 1)
            assert annotation["area"] == mask.sum()
            found[mask] = annotation["label"]
        assert np.array_equal(found, labels)
        assert len(annotations) == len(np.unique(labels[labels > 0]))
    assert len({annotation["id"] for annotation in coco.dataset["annotations"]}) == len(
        coco.dataset["annotations"]
    )


def test_frames_of_another_camera_are_refused(tmp_path: Path) -> None:
    Annotation(small_result()).save(tmp_path)
    before = sorted(path.name for path in tmp_path.iterdir())
    other = Calibration.registered(Intrinsics(160, 120, 120.0, 120.0, 79.5, 59.5))
    with pytest.raises(ValueError, match=r"calibration.yml: is of another camera; save to another folder"):
        Annotation(small_result(1, calibration=other)).save(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"images": 3}', '{"images": [{"id": 1}]}', '{"annotations": [7]}']
)
def test_annotations_that_others_have_damaged_are_named_and_kept(tmp_path: Path, content: str) -> None:
    (tmp_path / "annotations.json").write_text(content)
    with pytest.raises(ValueError, match=r"annotations.json"):
        Annotation(small_result()).save(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["annotations.json"]
    assert (tmp_path / "annotations.json").read_text() == content


def test_other_entries_of_a_coco_file_stay(tmp_path: Path) -> None:
    theirs = {
        "info": {"year": 2020},
        "images": [{"id": 7, "file_name": "a.png", "width": 3, "height": 2}],
        "annotations": [{"id": 1, "image_id": 7, "category_id": 1, "bbox": [0, 0, 1, 1]}],
        "categories": [{"id": 1, "name": "cup"}],
    }
    (tmp_path / "annotations.json").write_text(json.dumps(theirs))
    Annotation(small_result()).save(tmp_path)
    document = json.loads((tmp_path / "annotations.json").read_text())
    assert document["info"] == {"year": 2020}
    assert document["categories"] == theirs["categories"]
    assert document["images"][0] == theirs["images"][0]
    assert document["annotations"][0] == theirs["annotations"][0]
    assert {annotation["image_id"] for annotation in document["annotations"][1:]} == {8}


def test_nothing_is_written_where_a_file_is(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileExistsError, match="file"):
        Annotation(small_result()).save(tmp_path / "file")


def test_a_frame_without_depth_has_no_labels_to_save(tmp_path: Path) -> None:
    from nurbseg import segment

    frame = small_frame()
    empty = segment(replace(frame, depth_mm=np.zeros_like(frame.depth_mm), labels=None))
    annotation = Annotation(empty)
    assert annotation.objects == ()
    annotation.save(tmp_path)
    assert json.loads((tmp_path / "annotations.json").read_text())["annotations"] == []
