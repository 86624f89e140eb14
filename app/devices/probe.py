"""Lists OpenNI2's cameras in another process, because its drivers may crash or hang."""

import json
import signal
import subprocess

from nurbseg.common.process.child import environment, python_command, with_parent_death_signal
from nurbseg.drivers.doctor.diagnosis import Probe
from nurbseg.drivers.openni2.usb_ids import WANTED

#: Time limit, seconds: a driver waits some seconds for a camera that does not answer.
_TIME_LIMIT_S = 20.0


def probe(wanted: str = "any", *, time_limit_s: float = _TIME_LIMIT_S) -> Probe:
    """Return which cameras OpenNI2 lists and opens, of those that `wanted` (of `--device`) selects."""
    command = python_command("nurbseg.app.devices.devices_command", "list", "--json")
    try:
        done = subprocess.run(
            with_parent_death_signal(command),
            env=environment(),
            capture_output=True,
            text=True,
            timeout=time_limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Probe(error=f"OpenNI2, or one of its drivers, did not answer within {time_limit_s:g} s.")
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        return Probe(error=f"OpenNI2, or one of its drivers, crashed ({name}).")
    try:
        # Drivers sometimes print something first.
        cameras = json.loads(done.stdout[done.stdout.index("{") :])["cameras"]
    except ValueError:
        words = done.stderr.strip().splitlines()
        return Probe(
            error=words[-1].removeprefix("nurbseg-devices: error: ") if words else "It gave no answer."
        )
    matching = [camera for camera in cameras if _is_meant(camera, wanted.removeprefix("openni2:"))]
    return Probe(
        cameras=tuple(_name(camera) for camera in matching if not camera["error"]),
        doubts=tuple(f"{_name(camera)} {doubt}" for camera in matching for doubt in camera["doubts"]),
        refused=tuple((_name(camera), camera["error"]) for camera in matching if camera["error"]),
    )


def _is_meant(camera: dict[str, str], word: str) -> bool:
    if word.lower() in ("", "any"):
        return True
    if word.lower() == "realsense":
        return camera["family"] == "realsense"
    if word.lower() in WANTED:
        return camera["family"] in WANTED[word.lower()]
    return word in (camera["uri"], camera["serial"], f"port:{camera['usb_port']}")


def _name(camera: dict[str, str]) -> str:
    serial = f", serial {camera['serial']}" if camera["serial"] else ""
    return f"{camera['name']} ({camera['usb_id']}{serial})"
