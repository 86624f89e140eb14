"""What starting and reaching viewers has in common."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest

from nurbseg.app.settings.output_config import ViewConfig, ViewMode
from nurbseg.app.view.opening import chosen_view
from nurbseg.app.view.viewer import free_port, viewer_command, warn_beyond_loopback


@pytest.mark.parametrize("bind", ["127.0.0.1", "127.8.8.8", "::1"])
def test_nothing_is_said_of_a_stream_for_this_computer_alone(
    bind: str, caplog: pytest.LogCaptureFixture
) -> None:
    warn_beyond_loopback(bind, 9876)
    assert caplog.records == []


@pytest.mark.parametrize("bind", ["0.0.0.0", "192.168.1.5", "::"])
def test_binding_to_other_addresses_warns_and_names_the_ports(
    bind: str, caplog: pytest.LogCaptureFixture
) -> None:
    warn_beyond_loopback(bind, 9876, 9090)
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert bind in record.getMessage()
    assert "9876 and 9090" in record.getMessage()
    assert "no password or encryption" in record.getMessage()


@pytest.mark.parametrize(
    ("mode", "display", "interactive", "expected"),
    [
        ("auto", "", True, "serve"),
        ("auto", "", False, "auto"),
        ("auto", ":0", True, "auto"),
        ("none", "", True, "none"),
    ],
)
def test_somebody_who_waits_without_a_display_is_served_a_page(
    monkeypatch: pytest.MonkeyPatch, mode: ViewMode, display: str, interactive: bool, expected: str
) -> None:
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    view = chosen_view(ViewConfig(mode=mode), interactive=interactive)
    assert view.mode == expected
    assert view.bind == "127.0.0.1"


def test_a_page_that_was_not_requested_takes_no_port_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        view = chosen_view(ViewConfig(port=port, web_port=free_port("127.0.0.1")), interactive=True)
    assert (view.port, view.web_port == 0) == (0, False)


def test_what_opens_a_recording_needs_no_active_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without it a shell finds no `rerun`, or that of another environment."""
    for name in ("ours", "theirs"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "rerun").touch(mode=0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "ours" / "python3.11"))
    commands = []
    for path in ("ours", "theirs", "none"):
        monkeypatch.setenv("PATH", str(tmp_path / path))
        commands.append(viewer_command("my a.rrd"))
    monkeypatch.chdir(tmp_path)
    assert commands == ["rerun 'my a.rrd'", *2 * [f"{tmp_path}/ours/rerun 'my a.rrd'"]]
    assert viewer_command("a.rrd") == "ours/rerun a.rrd"
