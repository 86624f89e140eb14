"""Which USB ids belong to which depth camera, and which OpenNI2 driver each camera needs."""

from dataclasses import dataclass, replace
from typing import Literal

Role = Literal["camera", "motor", "audio"]

#: Words that `--device` takes, with the camera families they stand for.
WANTED: dict[str, tuple[str, ...]] = {
    "any": ("ps1080", "pslink", "kinect1", "kinect2", "orbbec", "xtion2"),
    "xtion": ("ps1080", "pslink", "xtion2"),
    "kinect": ("kinect1", "kinect2"),
    "orbbec": ("orbbec",),
}

PRIMESENSE = 0x1D27
MICROSOFT = 0x045E
ORBBEC = 0x2BC5
ASUS = 0x0B05


@dataclass(frozen=True, slots=True)
class Family:
    """Cameras that are driven alike.

    Debian's `package` brings their OpenNI2 driver, if any does. `install` are the steps where it is missing;
    ``{drivers}`` stands for the drivers folder and ``{suffix}`` for the ending that the installed OpenNI2
    loads. `speed_min` is the slowest USB speed that they work at, and `usb3_trouble` whether old firmware is
    known to fail behind a USB 3 controller.
    """

    key: str
    name: str
    driver: str
    install: tuple[str, ...]
    package: str = ""
    speed_min: Literal["high", "super"] = "high"
    usb3_trouble: bool = False

    @property
    def file_stem(self) -> str:
        """How the name of the driver's file begins, in lower case."""
        return f"lib{self.driver.lower().removeprefix('lib')}"


@dataclass(frozen=True, slots=True)
class Model:
    """What a vendor and product id stand for: a camera, or another part of one, with its name."""

    family: Family
    role: Role
    name: str


_DEBIAN = "libopenni2-0"
_REINSTALL = (f"sudo apt install --reinstall {_DEBIAN}",)
_PS1080 = Family(
    "ps1080", "Xtion or PrimeSense camera", "PS1080", _REINSTALL, package=_DEBIAN, usb3_trouble=True
)
_PSLINK = replace(_PS1080, key="pslink", name="PrimeSense PSLink camera", driver="PSLink")
_KINECT1 = Family(
    "kinect1",
    "Kinect v1 (Xbox 360)",
    "FreenectDriver",
    (
        "sudo apt install git cmake g++ python3 libusb-1.0-0-dev",
        "git clone https://github.com/OpenKinect/libfreenect",
        "cmake -S libfreenect -B libfreenect/build -DBUILD_OPENNI2_DRIVER=ON -DBUILD_EXAMPLES=OFF",
        "cmake --build libfreenect/build",
        "sudo cp -L libfreenect/build/lib/OpenNI2-FreenectDriver/libFreenectDriver.so"
        " {drivers}/libFreenectDriver{suffix}",
    ),
)
_KINECT2 = Family(
    "kinect2",
    "Kinect v2 (Xbox One)",
    "libfreenect2-openni2",
    (
        "sudo apt install git cmake g++ pkg-config libusb-1.0-0-dev libturbojpeg0-dev"
        " libglfw3-dev libopenni2-dev",
        "git clone https://github.com/OpenKinect/libfreenect2",
        "cmake -S libfreenect2 -B libfreenect2/build -DBUILD_OPENNI2_DRIVER=ON",
        "cmake --build libfreenect2/build",
        "sudo cp -L libfreenect2/build/lib/libfreenect2-openni2.so {drivers}/libfreenect2-openni2{suffix}",
        "sudo cmake --install libfreenect2/build && sudo ldconfig",
    ),
    speed_min="super",
)
_ORBBEC = Family(
    "orbbec",
    "Orbbec Astra",
    "orbbec",
    (
        "download Orbbec's OpenNI SDK for Linux: https://www.orbbec.com/developers/openni-sdk/",
        "in the unpacked SDK, find the folder with libOpenNI2.so and OpenNI2/Drivers/liborbbec.so",
        "in that folder: ln -s libOpenNI2.so libOpenNI2.so.0",
        "export OPENNI2_REDIST=THAT_FOLDER   (the vendor's library then replaces Debian's)",
    ),
)
_XTION2 = Family(
    "xtion2",
    "Xtion 2",
    "SenDuck",
    (
        "download the SDK for Linux from ASUS: https://www.asus.com/supportonly/xtion%202/helpdesk_download/",
        "from the unpacked SDK: sudo cp ASUS/Xtion2/lib/libSenDuck.so {drivers}/libSenDuck{suffix}",
    ),
    speed_min="super",
)

FAMILIES: dict[str, Family] = {
    family.key: family for family in (_PS1080, _PSLINK, _KINECT1, _KINECT2, _ORBBEC, _XTION2)
}

#: Family, role, name, vendor and products.
_PARTS: tuple[tuple[Family, Role, str, int, tuple[int, ...]], ...] = (
    (_PS1080, "camera", "PrimeSense sensor", PRIMESENSE, (0x0500,)),
    (_PS1080, "camera", "Xtion PRO or Carmine", PRIMESENSE, (0x0600,)),
    (_PS1080, "camera", "Xtion PRO LIVE", PRIMESENSE, (0x0601,)),
    (_PS1080, "camera", "Carmine 1.09", PRIMESENSE, (0x0609,)),
    (_PSLINK, "camera", "PrimeSense PSLink", PRIMESENSE, (0x1250, 0x1260, 0x1270, 0x1280, 0x1290, 0xF9DB)),
    (_KINECT1, "camera", "Kinect v1", MICROSOFT, (0x02AE,)),
    (_KINECT1, "audio", "Kinect v1 audio", MICROSOFT, (0x02AD,)),
    (_KINECT1, "motor", "Kinect v1 motor", MICROSOFT, (0x02B0,)),
    (_KINECT1, "camera", "Kinect for Windows v1", MICROSOFT, (0x02BF,)),
    (_KINECT1, "audio", "Kinect for Windows v1 audio", MICROSOFT, (0x02BE, 0x02BB, 0x02C3)),
    (_KINECT1, "motor", "Kinect for Windows v1 motor", MICROSOFT, (0x02C2,)),
    (_KINECT2, "camera", "Kinect v2", MICROSOFT, (0x02C4, 0x02D8, 0x02D9)),
    (_ORBBEC, "camera", "Orbbec Astra", ORBBEC, (0x0401, 0x0402, 0x0403, 0x0404, 0x0407)),
)
_MODELS = {
    (vendor, product): Model(family, role, name)
    for family, role, name, vendor, products in _PARTS
    for product in products
}


def identify(vendor_id: int, product_id: int, product: str = "") -> Model | None:
    """Return which camera, or part of one, a USB device is; None where it is neither.

    An Xtion 2 is recognized by its own name, where that could be read.
    """
    model = _MODELS.get((vendor_id, product_id))
    if model is not None:
        return model
    if vendor_id == ORBBEC and product_id >> 8 in (0x05, 0x06):
        # 05xx are the color halves (plain webcams) of cameras whose depth half is 04xx or 06xx.
        return Model(_ORBBEC, "camera", "Orbbec Astra") if product_id >> 8 == 0x06 else None
    if vendor_id == ASUS and "xtion" in product.lower():
        return Model(_XTION2, "camera", product)
    return None


def families(wanted: str) -> tuple[Family, ...]:
    """Return the families that a word of `--device` stands for; all of them for a URI or serial number."""
    word = wanted.lower().removeprefix("openni2:")
    return tuple(FAMILIES[key] for key in WANTED.get(word, WANTED["any"]))
