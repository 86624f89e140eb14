"""What is wrong with the times of a recording's frames."""

from collections.abc import Mapping, Sequence

import numpy as np

#: A longer time between two frames is a jump of the clock, seconds.
LONGEST_STEP_S = 10.0


def stamp_findings(stamps_ns: Sequence[int], metadata: Mapping[str, str]) -> list[str]:
    """Return what a person should know of the times of all frames, nanoseconds, and of a source's clocks."""
    found = []
    if "(" in (clock := metadata.get("clock", "")):
        found.append(clock)
    if order := metadata.get("order", ""):
        found.append(order)
    if replaced := int(metadata.get("stamps_replaced", 0)):
        found.append(f"{replaced} wrong (0, out of range or far from the others), the log's times instead")
    steps_s = np.diff(np.array(stamps_ns, dtype=np.int64)).astype(np.float64) * 1e-9
    for name, places, amounts_s in (
        ("go back", np.flatnonzero(steps_s < 0), -steps_s),
        ("jump forward", np.flatnonzero(steps_s > LONGEST_STEP_S), steps_s),
    ):
        if places.size:
            largest = places[np.argmax(amounts_s[places])]
            times = "once" if places.size == 1 else f"{places.size} times"
            found.append(f"they {name} {times}, by up to {amounts_s[largest]:.3f} s, after frame {largest}")
    if repeated := int(np.count_nonzero(steps_s == 0)):
        found.append(f"{repeated} frames have the stamp of the one before")
    return found
