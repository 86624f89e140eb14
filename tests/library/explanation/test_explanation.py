"""Every number of an explanation is the tree's, and follows from the surfaces and the points."""

from __future__ import annotations

import base64
import re
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import Browser
from corner import FOCAL, corner
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from nurbseg import FrameResult, SegmentationConfig, Segmenter, open_source, segment
from nurbseg.common.frame import RGBDFrame
from nurbseg.library.explanation.explanation import Explanation
from nurbseg.library.explanation.panels import SIDES, WIDTH
from nurbseg.library.explanation.steps import Part, Step, parts_of
from nurbseg.segmentation import methods
from nurbseg.segmentation.judged import JudgedSplit
from nurbseg.segmentation.surfaces.surface import NurbsSurface

DEMO = Path(__file__).parents[3] / "recordings" / "demo.mcap"
CASES = [("nurbseg", "mse"), ("stag15", "mse"), ("nurbseg", "nle"), ("stag15", "vgc")]


@cache
def demo(method: str, metric: str) -> tuple[FrameResult, Explanation]:
    with open_source(DEMO) as source:
        frame = next(iter(source))
    result = segment(frame, SegmentationConfig(method=method, metric=metric))  # type: ignore[arg-type]
    return result, result.explain()


def fitted(step: Step) -> list[Part]:
    return [part for part in (step.whole, *step.parts) if part.fit.surface is not None]


@pytest.mark.parametrize(("method", "metric"), CASES)
def test_every_number_is_that_of_the_tree(method: str, metric: str) -> None:
    result, explanation = demo(method, metric)
    tree = result.tree
    assert [each.name for each in explanation.tree.segments] == [each.name for each in tree.segments]
    told = {step.name: step for step in explanation.steps if step.ratio is not None}
    assert set(told) == {each.name for each in tree.segments if each.trial is not None}
    assert {step.kept for step in told.values()} == {True, False}
    for name, step in told.items():
        trial = tree[name].trial
        assert trial is not None
        assert (step.metric, step.ratio, step.kept) == (metric, trial.ratio, trial.kept)
        assert (step.whole.value, step.whole.points) == (trial.value, trial.points)
        assert sorted((part.value or 0.0, part.points) for part in step.parts) == sorted(trial.parts)


@pytest.mark.parametrize(("method", "metric"), CASES)
def test_the_parts_of_a_split_are_the_whole_without_overlap(method: str, metric: str) -> None:
    for step in demo(method, metric)[1].steps:
        pixels = np.concatenate([part.fit.pixels for part in step.parts])
        assert len(step.parts) > 1
        np.testing.assert_array_equal(np.sort(pixels), np.sort(step.whole.fit.pixels))


def on_surface(surface: NurbsSurface, u: NDArray[np.intp], v: NDArray[np.intp]) -> NDArray[np.float64]:
    """Evaluate by SciPy, in homogeneous coordinates (The NURBS Book, eq. 4.15)."""
    net = np.concatenate([surface.control_points_m, np.ones((*surface.weights.shape, 1))], axis=2)
    net = net * surface.weights[..., np.newaxis]
    p, q = surface.degree
    bases_u = BSpline.design_matrix(u.astype(float), surface.knots_u, p).toarray()
    bases_v = BSpline.design_matrix(v.astype(float), surface.knots_v, q).toarray()
    points = np.einsum("nr,nc,rck->nk", bases_v, bases_u, net)
    return np.asarray(points[:, :3] / points[:, 3:])


@pytest.mark.parametrize(("method", "kept"), [("nurbseg", True), ("nurbseg", False), ("stag15", False)])
def test_residuals_and_metric_follow_from_surfaces_and_points(method: str, kept: bool) -> None:
    result, explanation = demo(method, "mse")
    step = next(step for step in explanation.steps if step.ratio is not None and step.kept is kept)
    weighed = []
    for part in fitted(step):
        v, u = np.divmod(part.fit.pixels, result.cloud.valid.shape[1])
        assert part.fit.surface is not None
        apart_m = np.linalg.norm(on_surface(part.fit.surface, u, v) - result.cloud.points_m[v, u], axis=1)
        np.testing.assert_allclose(part.fit.residuals_m, apart_m, rtol=1e-3, atol=2e-6)
        mse = max(float(np.mean(apart_m**2)), part.fit.floor)
        assert part.value == pytest.approx(mse, rel=1e-3)
        weighed.append(mse * part.points)
    assert step.ratio == pytest.approx(sum(weighed[1:]) / weighed[0], rel=2e-3)


def test_splits_are_told_in_the_order_in_which_they_were_tried() -> None:
    result, explanation = demo("stag15", "mse")
    tried: list[JudgedSplit] = []
    methods.segment(result.cloud, result.config, observe=tried.append)
    assert [step.ratio for step in explanation.steps] == [each.trial.ratio for each in tried]
    assert [step.number for step in explanation.steps] == list(range(1, len(tried) + 1))


def test_a_crease_is_told_with_the_values_that_decided_it() -> None:
    cloud = corner()[0]
    depth_mm = np.round(1000.0 * cloud.points_m[..., 2]).astype(np.uint16)
    result = segment(RGBDFrame.from_arrays(depth_mm, np.asarray(cloud.color), FOCAL, FOCAL, 159.5, 119.5))
    explanation = result.explain()
    (step,) = (step for step in explanation.steps if step.kind == "crease")
    trial = result.tree.root.trial
    assert trial is not None
    assert (step.name, step.metric, step.ratio, step.kept) == ("", "mse", trial.ratio, True)
    assert (step.whole.value, *(part.value for part in step.parts)) == (
        trial.value,
        *(value for value, _ in trial.parts),
    )
    for part, (_, points) in zip(step.parts, trial.parts, strict=True):
        # Nearly all points of a part are explained.
        assert 0.97 * part.points < points <= part.points
    percent = round(100.0 * (1.0 - trial.ratio))
    assert f"two parts meet in a crease; a surface folded there fits {percent} % better" in step.sentence
    assert step.verdict.endswith("T = 1: kept apart")


def test_the_stages_of_the_default_method_are_named() -> None:
    result, explanation = demo("nurbseg", "mse")
    divided = {each.name: str(each.division) for each in result.tree.segments if each.children}
    kinds = [step.kind for step in explanation.steps]
    assert [kinds.index(each) for each in ("gap", "cut", "fold", "protrusion", "merge")] == sorted(
        kinds.index(kind) for kind in set(kinds)
    )
    for step in explanation.steps:
        if step.kept:
            assert divided[step.name] == step.kind
    told = [step for step in explanation.steps if step.kind == "protrusion"]
    assert {step.name for step in told} == {name for name, how in divided.items() if how == "protrusion"}
    assert all(step.sentence.startswith("split off: one part stands in front") for step in told)


def test_a_fold_compares_two_leaves_of_the_tree_before_it() -> None:
    _, explanation = demo("nurbseg", "mse")
    folds = [step for step in explanation.steps if step.kind == "fold"]
    assert folds
    for step in folds:
        assert not step.kept
        assert [part.name for part in step.parts] == [None, None]
        assert step.sentence.startswith("one surface after all: two parts meet smoothly")


def test_objects_of_several_surfaces_are_the_last_steps() -> None:
    result, explanation = demo("nurbseg", "mse")
    merges = [step for step in explanation.steps if step.kind == "merge"]
    assert explanation.steps[-len(merges) :] == tuple(merges)
    several = [each.leaves for each in result.tree.objects if len(each.leaves) > 1]
    assert [tuple(part.name for part in step.parts) for step in merges] == several
    for step, leaves in zip(merges, several, strict=True):
        own = [
            contact
            for contact in result.tree.contacts
            if contact.first in leaves and contact.second in leaves
        ]
        assert [f"{each.log_odds:+.2f}" for each in sorted(own, key=lambda each: -each.log_odds)] == [
            re.findall(r"log odds (\S+):", text)[0] for text in step.evidence
        ]


def test_parts_know_their_side_of_the_cut() -> None:
    result, explanation = demo("nurbseg", "mse")
    for step in explanation.steps:
        if step.kind == "cut" and step.kept:
            first, second = result.tree[step.name].children
            for part, (_, side) in zip(
                step.parts, parts_of(explanation.tree, explanation.tree[step.name]), strict=True
            ):
                assert part.side == side
                assert (part.name or "").startswith((first, second)[side])


def test_pictures_have_the_colors_of_sides_and_of_residuals() -> None:
    result, explanation = demo("stag15", "mse")
    step = explanation.steps[0]
    drawn = explanation.panels(step)
    width = result.cloud.valid.shape[1]
    assert drawn.sides.shape == (round(WIDTH * result.cloud.valid.shape[0] / width), WIDTH, 3)
    for part in step.parts:
        rows, columns = np.divmod(part.fit.pixels, width)
        at = (rows * WIDTH // width, columns * WIDTH // width)
        photo = result.cloud.color[rows, columns].astype(float)
        wanted = 0.45 * photo + 0.55 * np.array(SIDES[part.side])
        # Interpolated at edges of the photograph, and outlined at those of the part.
        assert np.median(np.abs(drawn.sides[at] - wanted)) < 3.0
    # Blue is near, red far: the mean color follows the residuals.
    rows, columns = np.divmod(step.whole.fit.pixels, width)
    at = (rows * WIDTH // width, columns * WIDTH // width)
    redness = drawn.whole[at][:, 0].astype(float) - drawn.whole[at][:, 2]
    far, near = (
        step.whole.fit.residuals_m > drawn.largest_m,
        step.whole.fit.residuals_m < 0.1 * drawn.largest_m,
    )
    assert np.median(redness[far]) > 100
    assert np.median(redness[near]) < -100


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("why") / "a.html"
    demo("nurbseg", "mse")[1].save(path)
    return path


def test_the_page_has_all_steps_and_needs_no_other_host(page: Path) -> None:
    explanation, text = demo("nurbseg", "mse")[1], page.read_text(encoding="utf-8")
    assert not re.findall(r"https?://", text)
    assert not re.findall(r"(?:src|href)=\"(?!data:)", text)
    for step in explanation.steps:
        assert f"{step.sentence[1:]}</h1>".replace("'", "&#39;") in text
    images = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', text)
    assert len(images) == 1 + 3 * len(explanation.steps)
    for image in images[1:]:
        jpeg = np.frombuffer(base64.b64decode(image), dtype=np.uint8)
        assert cv2.imdecode(jpeg, cv2.IMREAD_COLOR).shape[1] == WIDTH
    assert page.stat().st_mode & 0o077 == 0


def test_the_nodes_of_the_tree_have_names_ratios_and_reasons(page: Path) -> None:
    explanation, text = demo("nurbseg", "mse")[1], page.read_text(encoding="utf-8")
    titles = re.findall(r"<title>(P[^<]*)</title>", text)
    for each in explanation.tree.segments:
        own = [title for title in titles if title.startswith(f"P{each.name}, ")]
        # But for segments that only chain others.
        assert len(own) == 1 or str(each.division) == "gap"
        assert all(f"{each.pixels.size:,} pixels" in title for title in own)
    for step in explanation.steps:
        if step.kind != "merge" and step.ratio is not None:
            assert re.search(rf'data-step="{step.number}".*>P{step.name}<tspan> {step.ratio:.2f}', text)


def test_the_page_goes_to_steps_and_objects_and_shows_the_tree_as_it_was_then(
    page: Path, tmp_path: Path
) -> None:
    result, explanation = demo("nurbseg", "mse")
    assert set(explanation.step_of_object) == {each.label for each in result.objects}
    with closing(Browser(tmp_path / "profile")) as browser:
        browser.open(page.as_uri())
        shown = "[...document.querySelectorAll('section')].findIndex(each => !each.hidden)"
        browser.wait_for(f"document.readyState === 'complete' && {shown} === 0")
        browser.evaluate("document.querySelector('nav > button[value=\"1\"]').click()")
        assert browser.evaluate(shown) == 1
        # The root's parts are there, and nothing below them.
        faint = "[...document.querySelectorAll('#tree .faint[data-name]')].map(each => each.dataset.name)"
        parts = {part.name for part in explanation.steps[0].parts}
        nodes = "[...document.querySelectorAll('#tree [data-name]')].map(each => each.dataset.name)"
        assert set(browser.evaluate(nodes)) - set(browser.evaluate(faint)) == {"", *parts}
        for label, step in explanation.step_of_object.items():
            browser.evaluate(f"document.querySelector('form input').value = {label}")
            browser.evaluate("document.querySelector('form').requestSubmit()")
            assert browser.evaluate(shown) == step
            leaves = {leaf for each in [result.object(label)] for leaf in each.leaves}
            assert leaves <= {part.name for part in explanation.steps[step - 1].parts}
        browser.evaluate("document.querySelector('form input').value = 99")
        browser.evaluate("document.querySelector('form').requestSubmit()")
        assert "object 99 is not in this frame" in browser.evaluate(
            "document.querySelector('output').innerText"
        )
        assert browser.errors == []


def test_a_notebook_shows_the_page_in_a_frame() -> None:
    explanation = demo("stag15", "mse")[1]
    html = explanation._repr_html_()
    assert html.startswith("<iframe srcdoc=")
    assert html.count("<") == 2


def test_a_frame_of_a_sequence_is_explained_by_itself() -> None:
    segmenter = Segmenter()
    with open_source(DEMO) as source:
        frames = iter(source)
        results = [segmenter.process(next(frames)) for _ in range(2)]
    explanation = results[1].explain()
    assert explanation.title.startswith("frame 1 by itself, method nurbseg")
    alone = segment(results[1].frame)
    names = [each.name for each in alone.tree.segments]
    assert [each.name for each in explanation.tree.segments] == names


def test_a_frame_without_points_has_no_steps(tmp_path: Path) -> None:
    with open_source(DEMO) as source:
        frame = next(iter(source))
    explanation = segment(replace(frame, depth_mm=np.zeros_like(frame.depth_mm))).explain()
    assert explanation.steps == ()
    explanation.save(tmp_path / "a.html")
    assert "Nothing was split" in (tmp_path / "a.html").read_text()
