"""The clock of a camera beside that of the computer."""

import numpy as np
import pytest
from fake_clock import FakeClock

from nurbseg.drivers.live.device_clock import DeviceClock

PERIOD_S = 1 / 30


def timed(rate: float, frames: int, clock: FakeClock, device: DeviceClock) -> list[float]:
    """The timestamps, seconds, of frames at 30 Hz of a device whose clock runs at this rate."""
    found = []
    for number in range(frames):
        found.append(device.timestamp_us(5_000_000 + round(number * PERIOD_S * rate * 1e6)) * 1e-6)
        clock.now_s += PERIOD_S
    return found


@pytest.mark.parametrize("rate", [60.0, 2.0, 1 / 60])
def test_a_clock_of_another_rate_is_noticed_within_a_second_of_frames(rate: float, caplog) -> None:
    clock = FakeClock()
    device = DeviceClock("Kinect", clock=clock)
    stamps = timed(rate, 90, clock, device)
    assert device.is_wrong
    (*_, said) = caplog.messages
    assert said.startswith(f"Kinect: its clock runs {rate:.3g} times as fast as real time")
    # Three seconds of frames are three seconds, but for what passed before it was noticed.
    assert stamps[-1] - stamps[0] == pytest.approx(89 * PERIOD_S, abs=1.0)
    assert np.diff(stamps)[30:] == pytest.approx(PERIOD_S, abs=2e-6)
    assert np.diff(stamps).min() > 0


@pytest.mark.parametrize("rate", [1.0, 1.02, 0.98, 0.1])
def test_a_clock_that_agrees_or_is_as_slow_as_a_busy_camera_is_left_alone(rate: float, caplog) -> None:
    clock = FakeClock()
    device = DeviceClock("Xtion", clock=clock)
    expected = [5 + number * PERIOD_S * rate for number in range(900)]
    assert timed(rate, 900, clock, device) == pytest.approx(expected, abs=1e-6)
    assert not device.is_wrong
    assert caplog.messages == []


def test_late_reading_pauses_and_a_reset_are_no_faults_of_the_clock(caplog) -> None:
    clock = FakeClock()
    device = DeviceClock("Xtion", clock=clock)
    # Two seconds are not read, then what waited comes at once, then the newest; the camera pauses; reset.
    host_s = [0.0, 0.033, 2.033, 2.034, 2.035, 2.066, 7.0, 7.033, 7.066]
    device_s = [1.0, 1.033, 1.066, 1.099, 3.033, 3.066, 3.1, 3.133, 0.0]
    found = []
    for real_s, own_s in zip(host_s, device_s, strict=True):
        clock.now_s = 100 + real_s
        found.append(device.timestamp_us(round(own_s * 1e6)))
    assert found == [round(own_s * 1e6) for own_s in device_s]
    assert not device.is_wrong
    assert caplog.messages == []


def test_a_single_jump_is_bridged_by_real_time(caplog) -> None:
    clock = FakeClock()
    device = DeviceClock("Xtion", clock=clock)
    found = []
    for number in range(60):
        jump_us = 3_600_000_000 if number >= 20 else 0
        found.append(device.timestamp_us(number * 33_333 + jump_us))
        clock.now_s += 0.033333
    assert np.diff(found) == pytest.approx(33_333, abs=2)
    assert not device.is_wrong
    assert caplog.messages == ["Xtion: its clock jumps by 3600.0 s; the time goes on"]
