"""Corrections of the objects of the frame that is shown, while the run is paused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.app.view.view import View
from nurbseg.library.result import FrameResult

if TYPE_CHECKING:
    from nurbseg.library.annotation.annotation import Annotation


class Corrections:
    """The newest frame as it is corrected by commands.

    Its labels are saved in the working folder, in a folder that is named after the source, a URI. What is
    corrected is shown by `view` at once.
    """

    def __init__(self, source: str, view: View) -> None:
        name = re.sub(r"[^\w.-]", "_", Path(source).stem)
        self._folder = Path.cwd() / f"labels-{name}"
        self._view = view
        self._begun: FrameResult | None = None
        self._annotation: Annotation | None = None
        #: As it was saved last, or as it was when leaving it was refused.
        self._saved: FrameResult | None = None
        self._held: FrameResult | None = None

    def meet(self, result: FrameResult) -> FrameResult:
        """Return a frame as it was corrected, if it is still the same; a new one has no corrections yet."""
        begun = self._begun
        if begun is not None and begun.frame is result.frame and begun.config == result.config:
            return result if self._annotation is None else self._annotation.result
        self._begun = self._saved = result
        self._annotation = self._held = None
        return result

    @property
    def status(self) -> str:
        """How many corrections there are, and whether they are saved; empty if there are none."""
        annotation = self._annotation
        count = 0 if annotation is None else annotation.corrections
        saved = ", saved" if annotation is not None and annotation.result is self._saved else ""
        return f"{count} correction{'s' * (count != 1)}{saved}" if count else ""

    @property
    def found(self) -> str:
        """How many objects the corrected frame has; empty if nothing was corrected."""
        annotation = self._annotation
        return f"{len(annotation.objects)} objects" if annotation is not None else ""

    def hold(self, command: str) -> None:
        """Raise ValueError if a command would drop corrections that were not saved, but only once."""
        annotation = self._annotation
        if annotation is not None and annotation.result not in (self._saved, self._held):
            self._held = annotation.result
            raise ValueError(
                f"{self.status} not saved: save, or {command} once more to drop what was corrected"
            )

    def merge(self, words: str) -> str:
        """Merge the objects of these numbers."""
        labels = [_label(word) for word in words.split()]
        label = self._current().merge(*labels)
        return self._shown(f"merged {', '.join(map(str, labels[1:]))} into {label}")

    def split(self, words: str) -> str:
        """Split the object of this number in two, or with ``all`` into its surfaces."""
        word, _, how = words.partition(" ")
        if how not in ("", "all"):
            raise ValueError(f"expected the number of an object, or with it all, got {words[:80]!r}")
        annotation, number = self._current(), _label(word)
        label, *others = annotation.take_apart(number) if how else annotation.split(number)
        return self._shown(f"split {', '.join(map(str, others))} from {label}")

    def undo(self) -> str:
        """Take the last correction back."""
        self._current().undo()
        return self._shown("undone")

    def save(self) -> str:
        """Save the labels, corrected or not."""
        annotation = self._current()
        try:
            path = annotation.save(self._folder)
        except OSError as err:
            raise ValueError(f"{err.filename}: cannot be written: {err.strerror}") from err
        self._saved = annotation.result
        return f"saved {path}"

    def _current(self) -> Annotation:
        if self._begun is None:
            raise ValueError("there is no frame yet")
        from nurbseg.library.annotation.annotation import Annotation

        self._annotation = self._annotation or Annotation(self._begun)
        return self._annotation

    def _shown(self, said: str) -> str:
        annotation = self._current()
        self._view.every_frame_in_full = True
        self._view.show(annotation.result)
        return f"{said}: {len(annotation.objects)} objects"


def _label(word: str) -> int:
    if not word.isdecimal():
        raise ValueError(f"expected the numbers of objects, got {word[:80]!r}")
    return int(word)
