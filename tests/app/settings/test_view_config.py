from __future__ import annotations

import pytest

from nurbseg.app.settings.output_config import ViewConfig, viewer_address


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("camera-host", ("camera-host", 9876)),
        ("192.168.1.7:9999", ("192.168.1.7", 9999)),
        ("rerun+http://localhost:9876/proxy", ("localhost", 9876)),
        ("rerun+http://[::1]:1234/proxy", ("::1", 1234)),
    ],
)
def test_a_viewer_is_named_by_host_port_or_url(url: str, address: tuple[str, int]) -> None:
    assert viewer_address(url) == address


@pytest.mark.parametrize(
    "url", ["", "http://host:9876/proxy", "host:port", "rerun+http://host/other", "host:0"]
)
def test_an_address_that_cannot_be_read_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match=r"connect: expected HOST, HOST:9876 or rerun\+http"):
        ViewConfig(connect=url)


def test_the_address_is_completed_to_reruns_form() -> None:
    assert ViewConfig(connect="somewhere").viewer_url == "rerun+http://somewhere:9876/proxy"
    assert ViewConfig(connect="[::1]:77").viewer_url == "rerun+http://[::1]:77/proxy"
    assert ViewConfig(mode="connect").viewer_url == "rerun+http://127.0.0.1:9876/proxy"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mode": "window"}, "mode: expected one of auto, spawn, connect, serve, none, got 'window'"),
        ({"mode": "none", "connect": "host"}, "connect: needs --view connect or auto, got none"),
        ({"bind": "everywhere"}, "bind: expected an IP address such as 127.0.0.1, got 'everywhere'"),
        ({"port": 70_000}, "port: expected a whole number, at least 0, at most 65535, got 70000"),
        ({"memory_limit": "much"}, "memory_limit: expected a size such as 2GB or 25%, got 'much'"),
        ({"jpeg_quality": 0}, "jpeg_quality: expected a whole number, at least 1, at most 100, got 0"),
        ({"residual_max_m": 0.0}, "residual_max_m: expected a finite number, more than 0, got 0.0"),
    ],
)
def test_settings_out_of_bounds_are_named(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match="^" + message.replace("(", r"\(") + "$"):
        ViewConfig(**settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("limit", ["2GB", "500MB", "1GiB", "25%"])
def test_memory_is_limited_in_reruns_units(limit: str) -> None:
    assert ViewConfig(memory_limit=limit).memory_limit == limit


def test_nothing_listens_beyond_this_computer_by_default() -> None:
    assert ViewConfig().bind == "127.0.0.1"


@pytest.mark.parametrize("name", ["a.txt", "run.mcap", "run.2024"])
def test_what_is_saved_is_a_file_of_rerun(name: str) -> None:
    with pytest.raises(ValueError, match=rf"save: expected a name that ends in \.rrd, got '{name}'"):
        ViewConfig(save=name)


@pytest.mark.parametrize("name", ["a.rrd", "A.RRD", "/dev/full", "run-{date}"])
def test_a_device_and_a_name_without_an_ending_are_taken(name: str) -> None:
    assert ViewConfig(save=name).save == name
