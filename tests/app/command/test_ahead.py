from pathlib import Path

from child_python import run_python

DEMO = Path(__file__).parents[3] / "recordings" / "demo.mcap"
_CALLS = """
import sys

from numba import types, typeof
from numba.core.dispatcher import Dispatcher

from nurbseg.library.segmenter import process_frame
from nurbseg.app.live.warmup import WarmUp
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig

called, find = {}, Dispatcher._compile_for_args

def spy(function, *arguments):
    if function.py_func.__module__.startswith("nurbseg"):
        called.setdefault((function, tuple(map(typeof, arguments))))
    return find(function, *arguments)

def written(kind):
    if isinstance(kind, types.Array):
        axes = [":"] * kind.ndim
        if kind.layout == "C":
            axes[-1] = "::1"
        record = "KNOWN" if "unseen" in str(kind.dtype) else "SEEN"
        name = record if isinstance(kind.dtype, types.Record) else kind.dtype
        text = f"{name}[{', '.join(axes)}]"
        return text if kind.mutable else f"readonly({text})"
    if isinstance(kind, types.BaseTuple):
        name = kind.instance_class.__name__ if hasattr(kind, "instance_class") else ""
        return f"{name}({', '.join(map(written, kind.types))})"
    return str(kind)

Dispatcher._compile_for_args = spy
with open_source(sys.argv[1]) as source:
    process_frame(source.read())
alone = list(called)
WarmUp(SegmentationConfig(), temporal=True).wait()
live = list(called)[len(alone):]
fit = [function.__name__ for function, _ in alone].index("fit_splines")
needed = [alone[fit], *alone[:fit:-1], *live[::-1]]
for function, kinds in needed:
    module = function.py_func.__module__.removeprefix("nurbseg.")
    print(f"{module}.{function.__name__}: {', '.join(map(written, kinds))}")
"""
_READ = """
from nurbseg.app.command import ahead

print(list(ahead.functions()) == needed)
"""


def test_what_a_run_calls_is_compiled_ahead_for_the_same_types_and_the_last_first() -> None:
    *calls, is_so = run_python(_CALLS + _READ, str(DEMO)).stdout.splitlines()
    assert is_so == "True", "\n".join(["ahead.txt has to be:", *calls])
