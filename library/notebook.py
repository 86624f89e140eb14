"""Showing things in a notebook."""

from typing import Any


def show(what: Any, otherwise: str) -> None:
    """Show something in a notebook, also within a loop.

    Parameters
    ----------
    what : object
        What IPython can display.
    otherwise : str
        What to do outside of a notebook, for the error.

    Raises
    ------
    RuntimeError
        If this is no notebook: IPython is missing.
    """
    try:
        from IPython.display import display  # type: ignore[import-not-found]
    except ImportError as err:
        raise RuntimeError(f"show() is for notebooks; {otherwise}") from err
    display(what)
