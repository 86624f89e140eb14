"""Every reader with files that were changed at random: typed errors only. For longer: benchmarks/fuzz.py."""

import random
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutants import Form, forms, mutant, read_mutant

NAMES = (
    "plain.mcap", "png.mcap", "raw.mcap", "jpeg95.mcap", "a.db3", "a.bag",
    "depth.txt", "image.png", "image.tiff", "image.pgm", "image.jpg", "image.ppm", "image.bmp", "image.tif",
    "stereo.toml", "stereo.xml", "stereo.yml", "ros.yaml", "matrix.txt", "config.toml",
)  # fmt: skip


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> dict[str, Form]:
    return forms(tmp_path_factory.mktemp("corpus"))


def test_each_form_of_the_corpus_is_tried_and_whole(corpus: dict[str, Form], tmp_path: Path) -> None:
    assert set(NAMES) == set(corpus)
    for name, form in corpus.items():
        # A color image is no depth image, and the other way round.
        if not name.startswith("image."):
            assert not read_mutant(form, form.content, tmp_path), name


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_changed_file_is_read_or_refused(corpus, tmp_path: Path, name: str, seed: int) -> None:
    read_mutant(corpus[name], mutant(corpus[name].content, random.Random(seed)), tmp_path)
