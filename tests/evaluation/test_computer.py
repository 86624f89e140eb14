"""Tables can be made again on another processor, and say what they were made on."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info

from nurbseg.common.computer import computer, pin_blas_kernel

_KERNEL = """
import numpy
from threadpoolctl import threadpool_info
print({each.get("architecture") for each in threadpool_info() if each["internal_api"] == "openblas"})
"""


def flags() -> set[str]:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return set(next((line for line in lines if line.startswith("flags")), "").split())


@pytest.fixture(scope="module")
def kernels() -> tuple[str, str]:
    """Two kernels that OpenBLAS can be told to run on this processor."""
    if not {"avx2", "fma"} <= flags():
        pytest.skip("no kernel is chosen on a processor without AVX2 and FMA")
    asked = "Haswell", "SkylakeX" if "avx512vl" in flags() else "Nehalem"
    for kernel in asked:
        run = subprocess.run(
            [sys.executable, "-c", _KERNEL],
            env={**os.environ, "OPENBLAS_CORETYPE": kernel},
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        if run.stdout.strip() != str({kernel}):
            pytest.skip(f"OpenBLAS runs {run.stdout.strip()} where {kernel} is asked for")
    return asked


def study(folder: Path, out: Path, kernel: str, *words: str) -> tuple[str, str]:
    """Run a study in a process told to run a kernel: results by frame, and what the tables say of it."""
    command = [sys.executable, "-m", "nurbseg.evaluation.eval_command", "run", str(folder), "--out", str(out)]
    subprocess.run(
        [*command, "--no-report", "--time-frames", "0", *words],
        env={**os.environ, "OPENBLAS_CORETYPE": kernel},
        capture_output=True,
        timeout=240,
        check=True,
    )
    return (out / "results.csv").read_text(), (out / "tables.md").read_text().splitlines()[0]


def test_a_study_has_the_same_results_with_any_requested_kernel(frames: Path, tmp_path: Path, kernels):
    words = ("--methods", "nurbseg,stag15", "--frames", "2")
    first, second = (study(frames, tmp_path / kernel, kernel, *words) for kernel in kernels)
    assert first == second
    assert "openblas Haswell" in first[1]
    assert kernels[1] not in first[1]


def test_frames_that_another_kernel_cuts_otherwise_have_the_same_results(real_data, tmp_path: Path, kernels):
    words = ("--methods", "stag15", "--seed", "1", "--start", "12", "--frames", "1")
    words = (*words, "--intrinsics", "525,525,319.5,239.5")
    first, second = (study(real_data("mosd_learn"), tmp_path / kernel, kernel, *words) for kernel in kernels)
    assert first == second


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("flags\t\t: fpu avx2 fma avx512f\n", {"OPENBLAS_CORETYPE": "Haswell"}),
        ("flags\t\t: fpu avx fma\n", {"OPENBLAS_CORETYPE": "Zen"}),
        ("Features\t: fp asimd\n", {"OPENBLAS_CORETYPE": "Zen"}),
        (None, {"OPENBLAS_CORETYPE": "Zen"}),
    ],
    ids=["newer", "older", "another architecture", "no such file"],
)
def test_the_common_kernel_is_requested_if_the_processor_has_it(tmp_path: Path, said, expected):
    cpu_info = tmp_path / "cpuinfo"
    if said is not None:
        cpu_info.write_text(f"processor\t: 0\n{said}")
    environment = {"OPENBLAS_CORETYPE": "Zen"}
    pin_blas_kernel(environment, cpu_info)
    assert environment == expected


def test_the_processor_and_the_kernels_in_use_are_named():
    said = computer()
    for each in threadpool_info():
        if each["user_api"] == "blas":
            assert each["internal_api"] in said
            assert each.get("architecture", "") in said
    model = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    if model:
        assert said.startswith(model[0].split(":")[1].strip())
