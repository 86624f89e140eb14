"""Control of a run by commands."""
