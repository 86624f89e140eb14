"""The command nurbseg-devices, which lists and diagnoses cameras."""

import argparse
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from nurbseg.app.parser import command_parser

READY, NOT_READY = 0, 1

#: Time limit for OpenNI2, seconds.
_TIME_LIMIT_S = 60.0

_DESCRIPTION = """\
List the depth cameras on this computer, and find out why one does not work.
Without a command, the cameras are listed."""

_EPILOG = """\
exit codes: 0 a camera is ready (list, doctor), or the command succeeded; 1 otherwise; 2 usage
example: nurbseg-devices doctor --device kinect"""


def main(words: Sequence[str] | None = None) -> int:
    """Run the command with the process's arguments, or others; return its exit code."""
    from nurbseg.common.errors import DeviceNotFoundError, DriverError, printable

    arguments = _parser().parse_args(words)
    run: Callable[[argparse.Namespace], int] = arguments.run
    try:
        return run(arguments)
    except DriverError as err:
        print(f"nurbseg-devices: error: {printable(str(err))}", file=sys.stderr)
        if isinstance(err, DeviceNotFoundError):
            print("To find out why: nurbseg-devices doctor", file=sys.stderr)
        return NOT_READY


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("nurbseg-devices", _DESCRIPTION, _EPILOG)
    parser.set_defaults(run=_list, json=False)
    parser.add_argument("--json", action="store_true", help="write the list as JSON")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command")

    command = commands.add_parser("list", help="list the cameras that are connected (the default)")
    command.set_defaults(run=_list)
    command.add_argument("--json", action="store_true", help="write the list as JSON")

    command = commands.add_parser("doctor", help="find out why a camera does not work, and what to do")
    command.set_defaults(run=_doctor)
    _add_device(command, "which camera should work: xtion, kinect, orbbec, any, a URI or a serial number")
    command.add_argument("--json", action="store_true", help="write the findings as JSON")

    command = commands.add_parser("calibration", help="write the intrinsics that a camera reports to a file")
    command.set_defaults(run=_calibration)
    command.add_argument(
        "file", type=_toml_path, metavar="FILE.toml", help="file to write, for --calibration"
    )
    _add_device(command, "which camera: xtion, kinect, orbbec, any, a URI or a serial number")
    command.add_argument("--serial", default="", help="the camera with this serial number")
    command.add_argument("--force", action="store_true", help="overwrite an existing file")

    return parser


def _add_device(command: argparse.ArgumentParser, text: str) -> None:
    command.add_argument("--device", default="any", metavar="NAME", help=f"{text} (default: any)")


def _toml_path(text: str) -> Path:
    if not text.lower().endswith(".toml"):
        raise argparse.ArgumentTypeError(f"expected a file name that ends in .toml, got {text!r}")
    return Path(text)


def _list(arguments: argparse.Namespace) -> int:
    from nurbseg.app.devices import report as device_report
    from nurbseg.common.errors import BackendMissingError, DriverError, printable
    from nurbseg.drivers.doctor.camera_list import Camera, list_cameras
    from nurbseg.drivers.realsense.listing import list_realsense

    cameras: list[Camera] = []
    failures: list[DriverError] = []
    with _time_limit():
        for listed in (list_cameras, list_realsense):
            try:
                cameras += listed()
            except DriverError as err:
                failures.append(err)
    # Without cameras, a missing OpenNI2 is the answer; with some, it is of no interest.
    if not cameras and any(isinstance(err, BackendMissingError) for err in failures):
        raise failures[0]
    for failure in failures:
        if not isinstance(failure, BackendMissingError):
            print(f"nurbseg-devices: {printable(str(failure))}", file=sys.stderr)
    as_words = device_report.cameras_as_json if arguments.json else device_report.cameras_as_text
    print(as_words(cameras))
    return READY if any(not camera.error for camera in cameras) else NOT_READY


def _doctor(arguments: argparse.Namespace) -> int:
    from nurbseg.app.devices import report as device_report
    from nurbseg.app.devices.probe import probe
    from nurbseg.drivers.doctor.diagnosis import describe, diagnose, is_ready, probe_findings
    from nurbseg.drivers.realsense.listing import realsense_findings

    answer = probe(arguments.device)
    system = describe(probe=answer)
    names = (*answer.cameras, *(name for name, _ in answer.refused))
    listed = any("RealSense" in name for name in names)
    asked = arguments.device.lower().startswith("realsense")
    found = tuple(realsense_findings(system.devices, listed=listed, asked=asked))
    if asked:
        # What OpenNI2 lacks does not matter.
        findings = (*(probe_findings(answer, ()) if listed else ()), *found)
    else:
        findings = (*diagnose(system, arguments.device), *found)
    as_words = device_report.findings_as_json if arguments.json else device_report.findings_as_text
    print(as_words(findings, system))
    return READY if is_ready(findings) else NOT_READY


def _calibration(arguments: argparse.Namespace) -> int:
    from nurbseg.common.errors import DriverError
    from nurbseg.common.files import check_absent
    from nurbseg.drivers.calibration.file import write_calibration
    from nurbseg.drivers.openni2.device import DeviceSource
    from nurbseg.drivers.options import DeviceOptions

    path: Path = arguments.file
    try:
        check_absent(path, force=arguments.force)
    except FileExistsError as err:
        raise DriverError(f"{path}: already exists; --force overwrites it") from err
    except OSError as err:
        raise DriverError(f"{path}: {err.strerror}") from err
    # With the camera's own registration, frames would have one camera only.
    options = DeviceOptions(serial=arguments.serial, registration="software")
    # Warnings are about the very values that are written.
    logging.getLogger("nurbseg").addHandler(logging.NullHandler())
    with _time_limit(), DeviceSource(arguments.device.removeprefix("openni2:"), options) as source:
        calibration, name = source.calibration, source.metadata["device"]
    try:
        write_calibration(path, calibration)
    except OSError as err:
        raise DriverError(f"{path}: cannot be written: {err.strerror}") from err
    print(
        f"Written to {path}, for {name}:\n"
        f"  depth camera   {calibration.depth.width}x{calibration.depth.height}, focal length "
        f"{calibration.depth.fx:.1f} pixels, from the field of view it reports\n"
        f"  color camera   {calibration.color.width}x{calibration.color.height}, focal length "
        f"{calibration.color.fx:.1f} pixels, nominal\n"
        f"  offset         {-1e3 * calibration.color_from_depth[0, 3]:.0f} mm to the right, nominal\n"
        f"Use it with: nurbseg-live --calibration {path}\n"
        "docs/calibration.md explains how to measure what is nominal here."
    )
    return READY


@contextmanager
def _time_limit() -> Iterator[None]:
    """End the program if a driver hangs."""
    timer = threading.Timer(_TIME_LIMIT_S, _give_up)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _give_up() -> None:
    print(
        f"nurbseg-devices: error: OpenNI2, or one of its drivers, did not answer within {_TIME_LIMIT_S:g} s\n"
        "To find out why: nurbseg-devices doctor",
        file=sys.stderr,
        flush=True,
    )
    os._exit(NOT_READY)


if __name__ == "__main__":
    sys.exit(main())
