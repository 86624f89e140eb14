"""Shows values in notebooks."""


def show(shown: object, instead: str) -> None:
    """Show a value in a notebook, also within a loop.

    Raises RuntimeError if this is no notebook, as IPython is missing; says what to do `instead`.
    """
    try:
        from IPython.display import display  # type: ignore[import-not-found]
    except ImportError as err:
        raise RuntimeError(f"show() is for notebooks; {instead}") from err
    display(shown)
