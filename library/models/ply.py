"""Files of the form PLY."""

import numpy as np
from numpy.typing import NDArray

_PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<u2": "ushort", "<i4": "int"}


def ply(**elements: NDArray[np.void]) -> bytes:
    """Return a PLY file of elements, (N,) records each.

    A field with several numbers becomes a list, whose length must precede it as a field ``count``.
    """
    head = ["ply", "format binary_little_endian 1.0", "comment meters; x right, y down, z forward"]
    content = []
    for element, records in elements.items():
        head.append(f"element {element} {records.size}")
        for name, (kind, *_) in (records.dtype.fields or {}).items():
            if kind.shape:
                head.append(f"property list uchar {_PLY_TYPES[kind.base.str]} {name}")
            elif name != "count":
                head.append(f"property {_PLY_TYPES[kind.str]} {name}")
        content.append(records.tobytes())
    return ("\n".join([*head, "end_header"]) + "\n").encode() + b"".join(content)
