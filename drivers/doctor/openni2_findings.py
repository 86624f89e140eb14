"""What can be wrong with OpenNI2: its library, its settings, its drivers, and what it answers."""

from collections.abc import Iterator, Sequence

from nurbseg.drivers.doctor.finding import Finding, Part, Probe
from nurbseg.drivers.doctor.host import Installation
from nurbseg.drivers.openni2.library import LIBRARY_FILE, REDIST_VARIABLE


def library_findings(installation: Installation) -> Iterator[Finding]:
    """Report what is wrong with the library, its settings file and its drivers folder."""
    redist = installation.redist
    if not installation.library:
        if redist:
            yield Finding(
                "redist-wrong",
                f"{REDIST_VARIABLE} names a folder without OpenNI2",
                f"{REDIST_VARIABLE}={redist} is used instead of the system's library, "
                f"and there is no {LIBRARY_FILE} in it.",
                (
                    f"unset {REDIST_VARIABLE}   (uses the system's library)",
                    f"or, for a vendor's SDK: ln -s libOpenNI2.so {redist.rstrip('/')}/{LIBRARY_FILE}",
                ),
            )
        else:
            yield Finding(
                "library-missing",
                "The OpenNI2 library is not installed",
                f"There is no {LIBRARY_FILE} in the system's library folders.",
                (
                    "sudo apt install libopenni2-0   (Debian and Ubuntu)",
                    f"or set {REDIST_VARIABLE} to the folder of a vendor's OpenNI2",
                ),
            )
        return
    if redist:
        yield Finding(
            "redist-set",
            f"{REDIST_VARIABLE} is set",
            f"OpenNI2 and its drivers come from {redist}; the system's are not used.",
            severity="note",
        )
    if installation.repository:
        yield Finding(
            "drivers-folder-overridden",
            f"{installation.ini} sends OpenNI2 to another drivers folder",
            f"Repository={installation.repository}: drivers are loaded from there and nowhere else.",
            (f"sudo nano {installation.ini}   (a ; before the line restores the default folder)",),
            severity="warning",
        )
    if installation.override:
        yield Finding(
            "ini-override",
            f"{installation.ini} makes OpenNI2 open one device only",
            f"Override={installation.override} under [Device] replaces whichever camera is requested.",
            (f"sudo nano {installation.ini}   (put a ; before the line)",),
        )
    if not installation.drivers:
        yield Finding(
            "drivers-folder-empty",
            "OpenNI2 has no drivers to load",
            f"There is no *{installation.suffix} file in {installation.drivers_folder}.",
            (
                f"sudo nano {installation.ini}   (correct Repository=, or put a ; before it)"
                if installation.repository
                else f"put the drivers' files into {installation.drivers_folder}"
                if redist
                else "sudo apt install --reinstall libopenni2-0",
            ),
        )


def driver_findings(part: Part, installation: Installation) -> Iterator[Finding]:
    """Report whether OpenNI2 has the driver of a camera that is plugged in."""
    family, folder = part.model.family, installation.drivers_folder
    if not installation.drivers or installation.has_driver(family.file_stem):
        return
    misnamed = [each for each in installation.unloadable if each.lower().startswith(family.file_stem)]
    if misnamed:
        stem = misnamed[0].split(".so")[0]
        yield Finding(
            "driver-not-loadable",
            f"The driver of {part} has a name that OpenNI2 does not load",
            f"{folder}/{misnamed[0]} is there, but this OpenNI2 loads *{installation.suffix} only.",
            (f"sudo ln -s {misnamed[0]} {folder}/{stem}{installation.suffix}",),
        )
        return
    where = f"Debian's {family.package} provides it" if family.package else "Debian does not package it"
    yield Finding(
        "driver-missing",
        f"The driver of {part} is not installed",
        f"OpenNI2 needs the driver {family.driver} in {folder}. {where}.",
        tuple(step.format(drivers=folder, suffix=installation.suffix) for step in family.install),
    )


def probe_findings(probe: Probe, found: Sequence[Finding]) -> Iterator[Finding]:
    """Report what OpenNI2 returned when its cameras were listed.

    An error among what was found without asking explains an empty or failed answer.
    """
    for name in probe.cameras:
        yield Finding("ready", f"Ready: {name}", "It can be opened, and images arrive.", severity="ok")
    for doubt in probe.doubts:
        yield Finding("doubt", doubt, severity="warning")
    for name, words in probe.refused:
        yield Finding(
            "not-opened",
            f"OpenNI2 lists {name}, but it cannot be used",
            words,
            (
                "try a USB 2 port, or a USB 2 hub in between (docs/cameras.md, USB 3)"
                if "interface" in words.lower() or "no image" in words
                else "close other programs that use it, unplug it and plug it in again",
            ),
        )
    if any(each.severity == "error" for each in found) or probe.cameras or probe.refused:
        return
    if probe.error:
        yield Finding("openni2-failed", "OpenNI2 could not be queried for cameras", probe.error)
    else:
        yield Finding(
            "not-listed",
            "A camera is plugged in, but OpenNI2 does not list it",
            "Its driver is installed, but did not accept it.",
            ("unplug the camera, wait five seconds and plug it in again",),
        )
