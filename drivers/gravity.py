"""The direction of gravity, as an accelerometer on a camera shows it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

STANDARD_GRAVITY = 9.80665
#: Of standard gravity, what an accelerometer shows that is not being shaken.
_AT_REST = (0.7, 1.3)


def gravity_of(
    acceleration_m_s2: NDArray[np.float64], camera_from_sensor: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the direction of gravity in a camera's frame; None where the camera is being shaken.

    Parameters
    ----------
    acceleration_m_s2 : (3,) float64
        As accelerometers show it: at rest one of standard gravity upward, which is what holds them up.
    camera_from_sensor : (3, 3) float64
        Turn from the accelerometer's axes to the camera's.
    """
    length = float((acceleration_m_s2**2).sum() ** 0.5) / STANDARD_GRAVITY
    if not _AT_REST[0] < length < _AT_REST[1]:
        return None
    down: NDArray[np.float64] = camera_from_sensor @ -acceleration_m_s2
    return down
