"""The argument parsers of the commands."""

import argparse
import difflib
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn


class _Parser(argparse.ArgumentParser):
    """Suggests the nearest flags for an unknown one."""

    _words: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse, and keep the words for messages."""
        self._words = sys.argv[1:] if args is None else args
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Print the usage and a message, and exit."""
        if message.startswith("argument PATH: not allowed"):
            # The value of an unknown flag is taken for PATH, and refused before the flag is.
            flags = {"--", *_all_flags(self)}
            unknown = [word for word in self._words if word[:2] == "--" and word.split("=")[0] not in flags]
            message = f"unrecognized arguments: {' '.join(unknown)}" if unknown else message
        what, _, words = message.partition("unrecognized arguments: ")
        known = sorted(flag[2:] for flag in _all_flags(self))
        for word in (word for word in words.split() if word[:2] == "--" and not what):
            # Without the dashes, which all flags have in common.
            near = difflib.get_close_matches(word[2:].partition("=")[0], known, n=2)
            message += f"; {word} is near {' and '.join(f'--{flag}' for flag in near)}" if near else ""
        if what.endswith("expected one argument"):
            message += "; a name that begins with '-' is given as ./-NAME"
        files = any(Path(word).exists() for word in words.split())
        if files or message.startswith("argument PATH: not allowed"):
            message += "; one recording is replayed; put patterns in quotes, or the shell expands them"
        super().error(message)


class _ShortHelp(argparse.Action):
    """Prints the text in `const`."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        sys.stdout.write(str(self.const))
        parser.exit()


class _Version(argparse.Action):
    """Prints the version, which takes time to look up."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import PackageNotFoundError, version

        try:
            sys.stdout.write(f"{parser.prog} {version('nurbseg')}\n")
        except PackageNotFoundError:
            parser.exit(1, f"{parser.prog}: run from a folder, not installed as a package\n")
        parser.exit()


def _all_flags(parser: argparse.ArgumentParser) -> set[str]:
    """Return the flags of a parser and of its commands."""
    found = set()
    for action in parser._actions:
        if action.help != argparse.SUPPRESS:
            found |= {flag for flag in action.option_strings if flag.startswith("--")}
        if isinstance(action, argparse._SubParsersAction):
            found |= {flag for choice in action.choices.values() for flag in _all_flags(choice)}
    return found


def command_parser(
    prog: str, description: str, epilog: str, usage: str | None = None, short_help: str = ""
) -> argparse.ArgumentParser:
    """Return a parser that keeps line breaks of its texts, refuses abbreviated flags, and has --version.

    With `short_help`, --help prints that, and --help-all lists all flags.
    """
    parser = _Parser(
        prog=prog,
        usage=usage,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        add_help=not short_help,
    )
    add = partial(parser.add_argument, nargs=0, default=argparse.SUPPRESS)
    if short_help:
        text = "print the most important flags and exit"
        add("-h", "--help", action=_ShortHelp, const=short_help, help=text)
        parser.add_argument("--help-all", action="help", help="print this list of all flags and exit")
    add("--version", action=_Version, help="print the version and exit")
    return parser


def add_setting_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags for settings of the segmentation."""
    add, text = parser.add_argument, "a segmentation setting; may be repeated"
    add("--config", type=Path, metavar="FILE", help="read settings from a TOML file")
    add("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE", help=text)


def add_calibration_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags for recordings without calibration."""
    add, text = parser.add_argument, "depth units per meter, for data that does not specify them"
    add("--calibration", type=Path, metavar="FILE", help="calibration of both cameras, as for nurbseg-live")
    add("--intrinsics", metavar="FX,FY,CX,CY", help="in pixels, for data without calibration")
    add("--depth-scale", type=float, metavar="X", help=text)
