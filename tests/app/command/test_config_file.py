import dataclasses
import tomllib
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nurbseg.app.command.config_file import ConfigError, format_config, read_config
from nurbseg.app.settings.app_config import AppConfig, ExportConfig, SourceConfig
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.common.settings import Settings, described_fields, setting_paths, subsections
from nurbseg.drivers.options import DeviceOptions
from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig, Stag15Config

FULL = AppConfig(
    source=SourceConfig(
        replay='C:\\odd "name"\n\t\x7f é.mcap',
        fallback="other.mcap",
        speed=0.1,
        loop=True,
        start=3,
        frames=7,
        duration_s=1e-7,
        intrinsics=(525.0, 525.5, 319.5, 239.5),
        depth_scale=5000.0,
    ),
    camera=DeviceOptions(serial="A1", mirror=True, sync=False),
    segmentation=SegmentationConfig(
        metric="mmxc",
        ratio_max=0.8,
        geometry_weight=0.3,
        seed=5,
        stag15=Stag15Config(control_points="fixed"),
        extended=ExtendedConfig(level="surfaces", inverse_depth_noise=1e-3),
    ),
    view=ViewConfig(mode="none", save="a.rrd"),
    export=ExportConfig(directory="out", surfaces=True, report="r.json"),
)


def written(folder: Path, text: str) -> Path:
    path = folder / "run.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("config", [AppConfig(), FULL], ids=["defaults", "everything set"])
def test_a_printed_configuration_reads_back_as_the_same(config: AppConfig, tmp_path: Path) -> None:
    assert read_config(written(tmp_path, format_config(config))) == config


@given(
    st.builds(
        SourceConfig,
        replay=st.none() | st.text(st.characters(exclude_categories=["Cs"])),
        speed=st.floats(0, 1e300),
        duration_s=st.none() | st.floats(0, 1e300, exclude_min=True),
        intrinsics=st.none() | st.tuples(*[st.floats(1e-300, 1e300)] * 4),
        start=st.integers(0, 2**62),
    )
)
def test_any_value_survives_printing_and_reading(source: SourceConfig) -> None:
    assert SourceConfig(**tomllib.loads(format_config(AppConfig(source=source)))["source"]) == source


def test_every_setting_is_printed_with_what_it_means() -> None:
    lines = format_config(AppConfig()).splitlines()
    for _, field in setting_paths(AppConfig):
        # A name may be in several sections.
        before = [a for a, b in pairwise(lines) if b.removeprefix("#").startswith(f"{field.name} =")]
        assert sum(line.startswith(f"# {field.metadata['text']}") for line in before) == 1


def test_units_and_bounds_are_printed() -> None:
    text = format_config(AppConfig())
    assert "eq. 5) [more than 0]\nratio_max = 1.0" in text
    assert "[m, more than 0]\nlarge_error_m = 0.1" in text
    assert "at least 0, at most 64]\ndepth_max =" in text


def test_every_field_of_a_section_is_a_setting() -> None:
    for section in Settings.__subclasses__():
        settings = {field.name for field in described_fields(section)}
        assert {field.name for field in dataclasses.fields(section)} - {*subsections(section)} == settings


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[segmentation]\nratio_mx = 1\n", r"segmentation\.ratio_mx: no such .* segmentation\.ratio_max\?"),
        ("[source]\nratio_max = 1\n", r"source\.ratio_max: no such .* segmentation\.ratio_max\?"),
        ("[segmentation]\nlambda = 1\n", r"segmentation\.lambda: no such .* segmentation\.geometry_weight\?"),
        ("[segmentation]\nlamda = 1\n", r"segmentation\.lamda: no such .* segmentation\.geometry_weight\?"),
        ("[source]\nduration = 1\n", r"source\.duration: no such .* source\.duration_s\?"),
        ("[source]\nxyzzy = 1\n", r"source\.xyzzy: no such setting \(.*--print-config"),
        ("speed = 1\n", r"speed: no such .* source\.speed\?"),
        ("[segmentation.extended]\ncut = 1\n", r"extended\.cut: no such .* segmentation\.extended\.cuts\?"),
        ("[segmentation.stag51]\nlevel = 'objects'\n", r"\.stag51: no such .* \[segmentation\.stag15\]\?"),
        ("[segmentation]\nstag15 = 3\n", r"segmentation\.stag15: no such .* \[segmentation\.stag15\]\?"),
        (
            "[segmentation.extended]\ncuts = 0\n",
            r"segmentation\.extended\.cuts: expected a whole .* at most 10, got 0",
        ),
        ("[segmentaton]\n", r"segmentaton: no such .* \[segmentation\]\?"),
        ("source = 3\n", r"source: no such .* \[source\]\?"),
        ("[segmentation]\nratio_max = 0\n", r"n\.ratio_max: expected a finite number, more than 0, got 0"),
        ("[segmentation]\nratio_max = nan\n", r"\.ratio_max: expected a finite number, more than 0, got nan"),
        ("[segmentation]\nratio_max = true\n", r"\.ratio_max: expected a finite number, .*, got True"),
        ("[segmentation]\nsamples = 1.5\n", r"segmentation\.samples: expected a whole number, .*, got 1\.5"),
        ("[segmentation]\nmetric = 'mes'\n", r"n\.metric: .*, nlc, got 'mes' \(did you mean mse\?\)"),
        ("[source]\nloop = 1\n", r"source\.loop: expected true or false, got 1"),
        ("[source]\nreplay = 1\n", r"source\.replay: expected a text in quotes, got 1"),
        ("[source]\nintrinsics = [1, 2, 3]\n", r"source\.intrinsics: expected 4 numbers"),
        ("[source]\nintrinsics = [0, 1, 2, 3]\n", r"source\.intrinsics: expected focal lengths"),
        ("[source]\nreplay = 'a'\ndevice = 'any'\n", r"source\.device, replay: name one source"),
        ("[source\n", r"is not TOML: .*line 1"),
    ],
)
def test_a_wrong_file_is_refused_with_its_name_and_key(text: str, complaint: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=complaint) as caught:
        read_config(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_missing_file_and_a_file_of_other_bytes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: No such file"):
        read_config(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"binary\.toml: is not TOML"):
        read_config(tmp_path / "binary.toml")


def test_a_device_without_an_end_is_not_read_to_it() -> None:
    with pytest.raises(ConfigError, match=r"/dev/zero: is not TOML: "):
        read_config(Path("/dev/zero"))


def test_whole_numbers_may_stand_for_others(tmp_path: Path) -> None:
    config = read_config(written(tmp_path, "[source]\nspeed = 2\nintrinsics = [1, 2, 3, 4]\n"))
    assert (config.source.speed, type(config.source.speed)) == (2.0, float)
    assert config.source.intrinsics == (1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[source]\nspeed = " + "[" * 20_000, "lines of 4096"),
        ("[source]\nspeed = " + "[\n" * 20_000, "is not TOML: nested too deeply"),
        (f"[source]\nstart = {'9' * 5000}\n", "lines of 4096"),
        (f"[source]\nspeed = 0x{'f' * 4000}\n", "source.speed: expected a finite number, at least 0, got"),
        (f"[source]\nspeed = '{'x' * 4000}'\n", "source.speed: expected a finite number, at least 0, got"),
        (f"[source]\n{'x' * 4000} = 1\n", "source.xxx.*: no such setting"),
        (f"[source.{'x.' * 2000}x]\n", "source.x: no such setting"),
        (f"['{'x' * 4000}']\n", "xxx.*: no such setting"),
        ("[source]\nspeed = 2001-13-45\n", "is not TOML"),
        ("# " + "\n# " * 100_000, "characters at most"),
    ],
    ids=["nested", "lines", "digits", "hexadecimal", "text", "key", "path", "section", "date", "large"],
)
def test_a_hostile_file_gets_a_short_typed_error(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as found:
        read_config(written(tmp_path, text))
    assert len(str(found.value)) - len(str(tmp_path)) < 300
