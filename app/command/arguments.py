"""The command line of nurbseg-live: every setting is a flag, and flags override the configuration file."""

import argparse
from collections.abc import Sequence
from dataclasses import Field, dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, get_args

from nurbseg.app.parser import command_parser
from nurbseg.app.settings.app_config import SOURCE_KINDS, WITHOUT_FLAG, AppConfig, flags
from nurbseg.app.settings.output_config import export_forms
from nurbseg.common.settings import assigned, choices, describe, from_text, kinds, setting_paths, updated

_DESCRIPTION = """\
Segment the frames of a depth camera or a recording, and show and save the result.
Without a source, a camera is tried first, then the demo recording."""

_EPILOG = """\
exit codes: 0 done, 1 failed while running, 2 usage, configuration or no source, 130 after Ctrl-C,
143 after SIGTERM, 129 after SIGHUP (its terminal was closed)
example: nurbseg-live my_folder --intrinsics 525,525,319.5,239.5 --speed 0 --export out"""

_SHORT_HELP = """\
usage: nurbseg-live [PATH | --device NAME] [options]

Segment the frames of a depth camera or a recording, and show and save the
result. Without a source, a camera is tried first, then the demo recording.

source:
  PATH               a recording, or a folder of images
  --device NAME      a camera: xtion, kinect, orbbec, realsense, any, a number
  --intrinsics FX,FY,CX,CY
                     in pixels, for images without calibration
  --speed X          1 as recorded (default, but exports are of every frame),
                     0 every frame, as fast as possible
  --start N          skip frames
  --loop             restart a recording at its end
  --paused           begin paused at the first frame

segmentation:
  --method NAME      nurbseg (default), or stag15, the paper's
  --level NAME       what labels stand for: surfaces, objects (default)
  --metric NAME      mse (default), mae, ve, nle, vmxc, vmec, vgc, mmxc or nlc
  --threshold X      T: a split is kept if its ratio is below this (default: 1)

results:
  --view NAME        spawn (a window), serve (a web page), none, auto (default)
  --save FILE.rrd    all that is shown, for the viewer
  --export DIR       labels, tree (and objects: --export-objects) of each frame
  --publish HOW      results for other programs: jsonl or foxglove
  --record FILE      the camera's frames; --record-only segments nothing
  --explain FRAME    why one frame is segmented so, instead of a run

  --config FILE      settings as TOML; --print-config prints them
  --set NAME=VALUE   one of these settings
  --help-all         all flags, with units, bounds and defaults

h lists the keys of a run. Example: nurbseg-live kitchen.mcap --view serve
"""

#: Titles of the sections in the help, where they are not the names.
_TITLES = {
    "camera": "camera (--calibration also for --replay)",
    "depth": "preprocessing of depth images, in this order",
    "segmentation": "segmentation (the paper's symbols in the text)",
    "segmentation.stag15": "segmentation by the paper's method, --method stag15",
    "segmentation.extended": "segmentation by the default method, --method nurbseg",
    "live": "from frame to frame",
    "explain": "explanation of one frame",
    "export": "exported files",
    "record": "recording",
}
#: The settings of which at most one is given.
_SOURCES = [f"source.{kind}" for kind in SOURCE_KINDS]


@dataclass(frozen=True, slots=True)
class Arguments:
    """The command line: defaults, overridden by the configuration file, overridden by flags."""

    config: AppConfig
    #: Whether to print the configuration instead of running.
    print_config: bool
    #: -1 for warnings only, 0 for progress, 1 for every frame.
    verbosity: int


def parse_arguments(words: Sequence[str] | None = None) -> Arguments:
    """Parse the process's arguments, or others.

    Raises SystemExit with code 2 and a message on stderr if an argument or the configuration file is wrong,
    and with code 0 after ``--help`` and ``--version``.
    """
    parser = _parser()
    given = vars(parser.parse_args(words))
    names = ("config", "assignments", "print_config", "verbosity")
    path, assignments, print_config, verbosity = map(given.pop, names)
    config = AppConfig()
    try:
        if path is not None:
            from nurbseg.app.command.config_file import read_config  # late: few runs have a file

            config = read_config(path)
        config = _overridden(config, dict(assigned(AppConfig, text) for text in assignments) | given)
    except ValueError as err:
        parser.error(str(err))
    if config.export.directory is None:
        for each in export_forms():
            if getattr(config.export, each.name) != each.default:
                parser.error(f"{flags(each)[0]}: expected a folder too (--export DIR)")
    results = (config.export.directory, config.view.save, config.publish.how)
    if config.record.only and any(result is not None for result in results):
        parser.error("--record-only: nothing is segmented, so there are no results to write or publish")
    if config.explain.what is not None and any(each is not None for each in (*results, config.record.file)):
        without = "leave out --export, --save, --publish and --record"
        parser.error(f"--explain: one frame is explained instead of a run: {without}")
    if config.live.paused and (config.record.only or config.source.workers != 1):
        parser.error("--paused: there is nothing to look at with --record-only or --workers")
    return Arguments(config, print_config, verbosity)


def _parser() -> argparse.ArgumentParser:
    usage = "%(prog)s [PATH | --device NAME | --replay PATH] [options]"
    parser = command_parser("nurbseg-live", _DESCRIPTION, _EPILOG, usage, _SHORT_HELP)
    add = parser.add_argument
    text = "any setting of --print-config, also those without a flag; may be repeated"
    add("--config", type=Path, metavar="FILE", help="read settings from a TOML file")
    add("--set", dest="assignments", action="append", default=[], metavar="NAME=VALUE", help=text)
    text = "print the settings, with all flags applied, as TOML and exit"
    add("--print-config", action="store_true", help=text)
    loudness = parser.add_mutually_exclusive_group()
    add = partial(loudness.add_argument, dest="verbosity", action="store_const")
    add("--quiet", const=-1, default=0, help="log only warnings and errors")
    add("--verbose", const=1, help="log every frame")
    for name, settings in groupby(setting_paths(AppConfig), lambda each: each[0].rpartition(".")[0]):
        group = parser.add_argument_group(_TITLES.get(name, name))
        one_of = group.add_mutually_exclusive_group() if name == "source" else group
        if name == "source":
            one_of.add_argument(
                "source.replay", nargs="?", metavar="PATH", default=argparse.SUPPRESS, help="as --replay PATH"
            )
        for path, field in settings:
            if field.name not in WITHOUT_FLAG:
                add_flag(one_of if path in _SOURCES else group, path, field)
    return parser


def add_flag(group: Any, path: str, each: Field[Any]) -> None:
    """Add the flag of a setting to a parser or a group, without a default value."""
    text = describe(each).replace("%", "%%")
    options: dict[str, Any] = {"dest": path, "default": argparse.SUPPRESS}
    if each.type is bool:
        options["action"] = argparse.BooleanOptionalAction
        text += f" (default: {'on' if each.default else 'off'})"
    else:
        options |= {"type": partial(from_text, each), "metavar": _metavar(each)}
        text += f" (default: {each.default})" if each.default not in (None, "") else ""
    group.add_argument(*flags(each), help=text, **options)


def _metavar(each: Field[Any]) -> str:
    unit, (kind, *word) = str(each.metadata["unit"]), kinds(each)
    if choices(each):
        return "NAME"
    if unit and unit.upper() == unit:
        return unit
    number = "N" if kind is int else "X"
    number = {"px": "PIXELS", "s": "SECONDS", "m": "METERS"}.get(unit, number)
    return "|".join([number, *(get_args(each)[0] for each in word)])


def _overridden(config: AppConfig, given: dict[str, Any]) -> AppConfig:
    """Return the configuration overridden by flags; raises ValueError if one has an invalid value."""
    every = dict(setting_paths(AppConfig))
    if not given.keys().isdisjoint(_SOURCES):
        # A source named by a flag replaces that of the file.
        given = dict.fromkeys([*_SOURCES, "source.depth_images"]) | given
    try:
        for path, value in given.items():
            # Mostly a variable of a script that is not set: a path would be the working folder.
            if value == "" and every[path].default is None:
                raise ValueError(f"{path}: expected a value, got ''")
        result: AppConfig = updated(config, **given)
    except ValueError as err:
        path, _, message = str(err).partition(":")
        raise ValueError(
            f"argument {'/'.join(flags(every[path]))}:{message}" if path in every else str(err)
        ) from err
    return result
