"""Exports that somebody made to crash or exhaust the check: each file is named, and what is wrong with it."""

import io
import os
import zipfile

import numpy as np
import pytest
from hostile_files import GIB, black_png
from rendered import rendered

from nurbseg.evaluation.eval_command import main

TREE, LABELS, SURFACES = "000000_tree.json", "000000_labels.png", "000000_surfaces.npz"


def nested(path):
    path.write_text("[" * 100_000)


def enormous(path):
    os.truncate(path, 20 * GIB)


def a_pipe(path):
    path.unlink()
    os.mkfifo(path)


def endless(path):
    path.unlink()
    path.symlink_to("/dev/zero")


def too_many_pixels(path):
    path.write_bytes(black_png(60_000, 50_000))


def compressed_gigabytes(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("names.npy", "w") as file:
        for _ in range(17):
            file.write(bytes(1 << 24))


def array_of_terabytes(path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("names.npy", header.getvalue())


def damaged_within(path):
    content = bytearray(path.read_bytes())
    content[60:90] = bytes(30)
    path.write_bytes(content)


def with_array(part, make=None):
    """Change an array of the first surface, or leave it out."""

    def damage(path):
        with np.load(path) as opened:
            arrays = dict(opened)
        key = next(array for array in arrays if array.endswith(part))
        array = arrays.pop(key)
        np.savez(path, **arrays | ({key: make(array)} if make else {}))

    return damage


def with_number(text):
    def damage(path):
        path.write_text(path.read_text().replace('"value": ', f'"value": {text}, "x": ', 1))

    return damage


@pytest.mark.parametrize(
    ("file", "damage", "text"),
    [
        (TREE, nested, "recursion"),
        (TREE, enormous, "expected 16777216 at most"),
        (TREE, a_pipe, "not a regular file"),
        (TREE, endless, "not a regular file"),
        (TREE, with_number("NaN"), "P value: expected float, got nan"),
        (TREE, with_number("1" + "0" * 400), "P value: expected float, got 1000"),
        (LABELS, enormous, "expected 268435456 at most"),
        (LABELS, a_pipe, "not a regular file"),
        (LABELS, too_many_pixels, "expected 16777216 pixels at most"),
        (SURFACES, enormous, "expected 67108864 at most"),
        (SURFACES, a_pipe, "not a regular file"),
        (SURFACES, compressed_gigabytes, "expected 268435456 bytes at most in its arrays"),
        (SURFACES, array_of_terabytes, "Unable to allocate"),
        (SURFACES, damaged_within, "expected a file of an export"),
        (SURFACES, with_array("weights"), "expected a file of an export, found 'P_weights' is missing"),
        (SURFACES, with_array("window"), "expected a file of an export, found 'window' is missing"),
        (SURFACES, with_array("names", lambda _: np.zeros(())), "names: is an array () of float64"),
        (SURFACES, with_array("degree", lambda each: each[:, :1]), "degree: is an array"),
        (SURFACES, with_array("window", lambda each: each.astype(str)), "window: is an array"),
        (SURFACES, with_array("knots_u", lambda each: each.astype("S")), "P_knots_u: is an array"),
        (SURFACES, with_array("weights", np.ravel), "P_weights: is an array"),
        (SURFACES, with_array("measured", lambda each: each * np.nan), "P_measured: is an array"),
        (SURFACES, with_array("degree", lambda each: -each), "P knots_u: expected"),
        (SURFACES, with_array("degree", lambda each: each * 1000), "P knots_u: expected"),
        (
            SURFACES,
            with_array("knots_u", lambda each: each * np.nan),
            "P knots_u: expected numbers that ascend",
        ),
        (SURFACES, with_array("knots_v", lambda each: each * 0), "P knots_v: expected numbers that ascend"),
    ],
)
def test_a_hostile_file_of_a_frame_is_a_finding(export, file, damage, text):
    folder = export("stag15")
    damage(folder.folder / file)
    found = [
        finding for finding in folder.findings(rendered("width=160&height=120&frames=2")) if file in finding
    ]
    assert any(text in each for each in found), found
    assert all(len(each) < 1000 for each in found)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"target_fps": float("inf")}, "target_fps: expected float, got inf"),
        ({"temporal": 1}, "temporal: expected bool, got 1"),
        ({"segmentation": 1}, "segmentation: expected dict, got 1"),
        ({"segmentation": {"decimation": "2"}}, "segmentation.decimation: expected a whole number, at least"),
        ({"segmentation": {"extended": {"log_odds_min": float("nan")}}}, "log_odds_min: expected a finite"),
        ({"depth": None}, "depth: expected dict, got None"),
        (
            {"depth": {"range_max_m": "far"}},
            "depth.range_max_m: expected a finite number, at least 0, at most",
        ),
        ({"camera": {"depth": 1}}, "depth"),
    ],
)
def test_hostile_settings_are_named(export, capsys, change, text):
    path = export("stag15").settings(**change)
    assert main(["check", os.fspath(path.parent)]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"nurbseg-eval: error: {path}: ")
    assert text in told


def test_an_array_that_is_of_no_use_is_passed_over(export):
    folder = export("stag15")
    folder.arrays(lambda arrays: arrays.update(made_by=np.array("another program")))
    assert folder.findings() == []


@pytest.mark.parametrize("damage", [nested, enormous, a_pipe, endless])
def test_settings_that_cannot_be_read_are_named(export, capsys, damage):
    path = export("stag15").folder / "settings.json"
    damage(path)
    assert main(["check", os.fspath(path.parent)]) == 2
    assert f"{path}: " in capsys.readouterr().err


def test_findings_are_of_one_line_whatever_a_name_holds(export):
    folder = export("stag15")
    folder.tree(lambda segments: segments["P"].update(name="P\x1b[31m\n\ud800"))
    found = folder.findings()
    assert any(r"P\x1b[31m\n\ud800 depth: expected" in each for each in found)
    assert all(each.isprintable() for each in found)


def test_a_tree_of_another_size_than_the_recording_is_found(export):
    folder = export("stag15")
    folder.settings(camera=None)  # the cameras would differ
    found = folder.findings(rendered("width=80&height=60&frames=2"))
    assert "000000_tree.json: height, width: expected (60, 80) as recorded, found (120, 160)" in found
