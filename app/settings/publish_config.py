"""Settings of what a run gives to other programs while it goes on."""

from dataclasses import dataclass
from typing import NamedTuple

from nurbseg.common.settings import Settings, check_ip_address, setting

#: Where a server for Foxglove listens unless a port is given.
FOXGLOVE_PORT = 8765


class Publication(NamedTuple):
    """One way of publishing: its kind and what follows the colon."""

    kind: str
    target: str


@dataclass(frozen=True, slots=True)
class PublishConfig(Settings):
    """Settings of what a run gives to other programs while it goes on.

    Raises ValueError if a way of publishing is unknown, an address is none, or a file is no .mcap.
    """

    how: str | None = setting(
        None,
        "give results to other programs: jsonl (a line per frame on standard output), jsonl:PATH (on a Unix "
        "socket), foxglove or foxglove:PORT (8765; pip install 'nurbseg[foxglove]'), or several with commas",
        unit="HOW",
        flag="publish",
    )
    file: str | None = setting(
        None,
        "write the results as ROS 2 messages to an .mcap, which Foxglove, Rerun and ROS 2 open",
        unit="FILE",
        flag="save-objects",
    )
    bind: str = setting(
        "127.0.0.1", "address that the server for Foxglove listens on", unit="IP", flag="publish-bind"
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        check_ip_address("bind", self.bind)
        if self.file is not None and not self.file.lower().endswith(".mcap"):
            raise ValueError(f"file: expected a name that ends in .mcap, got {self.file!r}")
        for each in self.publications:
            if each.kind not in ("jsonl", "foxglove"):
                raise ValueError(f"how: expected jsonl or foxglove, got {each.kind!r}")
            if each.kind == "foxglove" and each.target and not _is_port(each.target):
                raise ValueError(f"how: expected a port from 1 to 65535, got {each.target!r}")

    @property
    def is_wanted(self) -> bool:
        """Whether anything is published or saved."""
        return self.how is not None or self.file is not None

    @property
    def publications(self) -> tuple[Publication, ...]:
        """What is asked for, in order."""
        asked = [] if self.how is None else self.how.split(",")
        return tuple(Publication(*each.strip().partition(":")[::2]) for each in asked)


def _is_port(text: str) -> bool:
    return text.isdecimal() and 1 <= int(text) <= 65535
