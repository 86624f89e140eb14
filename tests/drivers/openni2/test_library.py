"""Finding, loading and shutting down OpenNI2, and reading its answers."""

import ctypes
import subprocess
import sys
import textwrap
import threading
from contextlib import ExitStack

import pytest
from virtual_camera import native_threads

from nurbseg.common.errors import BackendMissingError, DeviceNotFoundError, DriverError
from nurbseg.drivers.openni2 import library as openni2
from nurbseg.drivers.openni2.capi import Status
from nurbseg.drivers.openni2.device import DeviceSource
from nurbseg.drivers.openni2.library import find_library, in_use


def run(program, **environment):
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        env=environment or None,
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_the_folder_in_the_environment_comes_first(virtual_cameras):
    assert find_library() == str(virtual_cameras.redist / "libOpenNI2.so.0")


def test_without_it_the_system_is_searched(monkeypatch):
    monkeypatch.delenv("OPENNI2_REDIST", raising=False)
    assert find_library() == "libOpenNI2.so.0"


def test_a_folder_without_the_library_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    with pytest.raises(BackendMissingError, match=rf"OPENNI2_REDIST={tmp_path}: no libOpenNI2\.so\.0"):
        DeviceSource()


def test_a_missing_library_names_the_package(monkeypatch):
    with pytest.raises(BackendMissingError, match=r"package libopenni2-0 \(apt install libopenni2-0\)"):
        openni2.Library("libNoSuchLibrary.so.0")


def test_another_library_of_that_name_is_distinguished(monkeypatch):
    with pytest.raises(BackendMissingError, match=r"libc\.so\.6 is not OpenNI2 2\.2"):
        openni2.Library("libc.so.6")


def test_a_folder_without_drivers_is_a_missing_backend(openni2_redist, tmp_path):
    (tmp_path / "libOpenNI2.so.0").symlink_to((openni2_redist / "libOpenNI2.so.0").resolve())
    finished = run(
        """
        from nurbseg.drivers.openni2.device import DeviceSource
        from nurbseg.common.errors import BackendMissingError
        try:
            DeviceSource()
        except BackendMissingError as err:
            print(err)
        """,
        OPENNI2_REDIST=str(tmp_path),
    )
    assert finished.returncode == 0, finished.stderr
    assert "no" in finished.stdout.lower()
    assert str(tmp_path) in finished.stdout


def test_the_last_user_shuts_the_library_down(virtual_cameras):
    virtual_cameras.add()
    before = native_threads()
    first, second = ExitStack(), ExitStack()
    library = first.enter_context(in_use())
    assert second.enter_context(in_use()) is library
    assert [device.uri for device in library.devices()] == ["virtual/one"]
    assert native_threads() > before  # the driver's
    first.close()
    assert library.devices()
    second.close()
    assert native_threads() == before


def test_many_threads_may_take_and_give_it(virtual_cameras):
    virtual_cameras.add()
    failures = []

    def work():
        try:
            for _ in range(50):
                with in_use() as library:
                    assert len(library.devices()) == 1
        except Exception as err:
            failures.append(err)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert not failures


def test_cameras_are_listed_with_their_ids(virtual_cameras):
    virtual_cameras.add("one", vendor="ASUS", name="Xtion", usb_vendor=0x1D27, usb_product=0x0600)
    with in_use() as library:
        (listing,) = library.devices()
        assert library.version().startswith("2.2.")
    assert (listing.vendor, listing.name) == ("ASUS", "Xtion")
    assert (listing.usb_vendor, listing.usb_product) == (0x1D27, 0x0600)


def test_answers_become_errors_with_the_librarys_words(virtual_cameras):
    with in_use() as library:
        handle = ctypes.c_void_p()
        status = library.native.oniDeviceOpen(b"no/such@device", ctypes.byref(handle))
        with pytest.raises(
            DeviceNotFoundError, match=r"opening it: OpenNI2 answers no device \(.*no/such@dev"
        ):
            library.check(status, "opening it")
        with pytest.raises(DriverError, match="trying: OpenNI2 answers status 77"):
            library.check(77, "trying")
        library.check(Status.OK, "nothing")


def test_the_program_ends_well_with_a_camera_left_open(virtual_cameras):
    camera = virtual_cameras.add()
    finished = run(
        f"""
        import threading
        from nurbseg.drivers import open_source
        source = open_source("openni2:")
        reading = threading.Event()

        def read():
            while True:
                source.read()
                reading.set()

        threading.Thread(target=read, daemon=True).start()
        assert reading.wait(30)
        open({str(camera.path)!r}, "w").write("plugged 0")  # disconnects while the interpreter goes
        """
    )
    assert finished.returncode == 0, finished.stderr
