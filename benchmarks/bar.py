"""How soon the bar of the served page shows what a press has done, in a real Chromium.

A recording is replayed live in a loop with `--view serve`, and the commands of the bar are pressed in turn,
at odd moments. The time is that until the page shows a state that is as asked and no longer marks the press;
a snapshot is then begun, but not yet written. `--no-viewer` leaves the viewer out of the page, as if another
computer showed it: without a graphics card, Chromium draws it on the processor.

Usage: python benchmarks/bar.py [SOURCE] [--rounds 10] [--no-viewer] [OPTIONS OF nurbseg-live ...]
"""

from __future__ import annotations

import argparse
import itertools
import random
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "fakes"))
# What opens the page in the tests opens it here.
from browser import Browser

COMMAND = Path(sys.executable).with_name("nurbseg-live")
DEMO = Path(__file__).parent.parent / "recordings" / "demo.mcap"
#: Each press: the widget, what it is set to (None: it is clicked), and what of the state holds then.
PRESSES = (
    ("Pause", None, "values.Pause === true"),
    ("Pause", None, "values.Pause === false"),
    ("T", "0.9", "values.T === 0.9"),
    ("Metric", "mae", "values.Metric === 'mae'"),
    ("Record", None, "values.Record === true"),
    ("T", "1", "values.T === 1"),
    ("Record", None, "values.Record === false"),
    ("Metric", "mse", "values.Metric === 'mse'"),
    ("Snapshot", None, "/^(writing|snapshot)/.test(said)"),
)
#: Until all is compiled and the rate is steady; between two presses; and the longest wait for one, seconds.
_SETTLE_S, _BETWEEN_S, _LIMIT_S = 15.0, (0.4, 0.9), 20.0


def main() -> None:
    """Print p50 and p90 of all presses, and of those of each widget."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", nargs="?", default=str(DEMO), help="what is replayed (the demo)")
    parser.add_argument("--rounds", type=int, default=10, help=f"of {len(PRESSES)} presses each (10)")
    parser.add_argument("--no-viewer", action="store_true", help="leave the viewer out of the page")
    options, rest = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as folder:
        run = [COMMAND, "--replay", str(Path(options.source).resolve()), "--loop", "--view", "serve", *rest]
        with subprocess.Popen(run, cwd=folder, stderr=subprocess.PIPE, text=True) as process:
            try:
                with closing(Browser(Path(folder) / "profile")) as browser:
                    report(measured(process, browser, options.rounds, shown=not options.no_viewer))
            finally:
                process.terminate()
                process.communicate(timeout=60.0)


def measured(
    process: subprocess.Popen[str], browser: Browser, rounds: int, *, shown: bool
) -> dict[str, list[float]]:
    """Return the times of the presses of each widget, ms."""
    assert process.stderr is not None
    address = next(line for line in process.stderr if "to look: " in line).split("to look: ")[1].strip()
    browser.open(address)
    browser.wait_for("document.getElementById('status').innerText.includes('frames/s')")
    if not shown:
        browser.evaluate("document.getElementById('viewer').remove()")
    time.sleep(_SETTLE_S)
    print(browser.evaluate("document.getElementById('status').innerText.replaceAll('\\n', ' | ')"))
    times: dict[str, list[float]] = {}
    for label, value, holds in itertools.chain.from_iterable([PRESSES] * rounds):
        time.sleep(random.uniform(*_BETWEEN_S))
        times.setdefault(label, []).append(pressed(browser, label, value, holds))
        if label == "Snapshot":
            browser.wait_for("document.getElementById('said').textContent.startsWith('snapshot: ')")
    assert not browser.errors, browser.errors
    return times


def pressed(browser: Browser, label: str, value: str | None, holds: str) -> float:
    """Press a widget; return the time until the page has shown the state that was asked for, ms."""
    act = f"control.value = '{value}'; control.dispatchEvent(new Event('change'))"
    answer = browser.evaluate(
        f"""new Promise((resolve) => {{
          const control = document.querySelector('[data-label="{label}"]');
          const began = performance.now();
          const limit = setTimeout(() => resolve(-1), {1e3 * _LIMIT_S});
          document.addEventListener("run", function shown({{ detail: {{ values, said }} }}) {{
            if (!({holds}) || control.classList.contains("pending")) return;
            document.removeEventListener("run", shown);
            clearTimeout(limit);
            resolve(performance.now() - began);
          }});
          {"control.click()" if value is None else act};
        }})"""
    )
    if answer < 0:
        raise SystemExit(f"{label}: not shown within {_LIMIT_S:g} s")
    return float(answer)


def report(times: dict[str, list[float]]) -> None:
    """Print a line for all presses and one for each widget."""
    for label, each_ms in {"all": list(itertools.chain(*times.values())), **times}.items():
        p50, p90, most = np.percentile(each_ms, [50, 90, 100])
        print(f"{label:<9}{len(each_ms):4d} presses, ms: p50 {p50:4.0f}, p90 {p90:4.0f}, most {most:4.0f}")


if __name__ == "__main__":
    main()
