"""What notebooks show."""

from typing import ClassVar


class Shown:
    """Something that IPython can display; `_instead` says what to do outside of a notebook."""

    __slots__ = ()
    _instead: ClassVar[str] = "picture() returns the image as an array"

    def show(self) -> None:
        """Show it in a notebook, also within a loop.

        Raises
        ------
        RuntimeError
            If this is no notebook: IPython is missing.
        """
        try:
            from IPython.display import display  # type: ignore[import-not-found]
        except ImportError as err:
            raise RuntimeError(f"show() is for notebooks; {self._instead}") from err
        display(self)
