"""Settings of the explanation of one frame."""

from dataclasses import dataclass

from nurbseg.common.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class ExplainConfig(Settings):
    """Settings of the explanation of one frame."""

    what: str | None = setting(
        None,
        "show why one frame was segmented so, split by split, instead of a run: its number in the replay, or "
        "what to replay, of which the first frame is taken",
        unit="FRAME|PATH",
        flag="explain",
    )
    directory: str | None = setting(
        None,
        "folder for the explanation: a page for any browser, a picture of each step, and a recording for "
        "Rerun (default: explanation-DATE-TIME-frameN)",
        unit="DIR",
        flag="explain-out",
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.directory is not None and self.what is None:
            raise ValueError("directory: expected a frame, too (--explain FRAME|PATH)")
