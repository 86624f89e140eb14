"""What starting and reaching viewers has in common."""

from __future__ import annotations

import pytest

from nurbseg.app.view.viewer import warn_beyond_loopback


@pytest.mark.parametrize("bind", ["127.0.0.1", "127.8.8.8", "::1"])
def test_nothing_is_said_of_a_stream_for_this_computer_alone(
    bind: str, caplog: pytest.LogCaptureFixture
) -> None:
    warn_beyond_loopback(bind, 9876)
    assert caplog.records == []


@pytest.mark.parametrize("bind", ["0.0.0.0", "192.168.1.5", "::"])
def test_who_lets_others_see_the_stream_is_warned_and_hears_the_ports(
    bind: str, caplog: pytest.LogCaptureFixture
) -> None:
    warn_beyond_loopback(bind, 9876, 9090)
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert bind in record.getMessage()
    assert "9876 and 9090" in record.getMessage()
    assert "neither password nor encryption" in record.getMessage()
