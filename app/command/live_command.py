"""The command nurbseg-live: flags, configuration, one run, an exit code."""

import gc
import logging
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import NoReturn

from nurbseg.app.command.arguments import Arguments, parse_arguments
from nurbseg.app.errors import ExportError, FrameFailedError, PublishError, ViewError, message_handler
from nurbseg.app.live.interruption import Interruption
from nurbseg.app.settings.app_config import AppConfig, warn_of_unread
from nurbseg.app.unwaited import Unwaited
from nurbseg.common.computer import limit_blas_threads
from nurbseg.common.process.child import ChildProcess
from nurbseg.common.settings import changed_paths

_log = logging.getLogger("nurbseg.live")

DONE, FAILED, NOT_STARTED = 0, 1, 2


def command() -> NoReturn:
    """Run the command with the process's arguments, and end the process with its exit code."""
    code = main()
    # Everything is closed. A thread that waits for a dead disk would keep the process alive forever.
    logging.shutdown()
    sys.stdout.flush()
    os._exit(code)


def main(words: Sequence[str] | None = None) -> int:
    """Run the command with the process's arguments, or others; return its exit code.

    Raises SystemExit as `parse_arguments` does.
    """
    # What is imported is kept: to look for garbage in it would take a tenth of the time. `run` enables this.
    gc.disable()
    try:
        with Unwaited(sys.stderr):
            return _main(words)
    finally:
        gc.enable()


def _main(words: Sequence[str] | None) -> int:
    limit_blas_threads()
    handler = message_handler("nurbseg-live", repeated=True)
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.captureWarnings(True)
    arguments = parse_arguments(words)
    if arguments.print_config:
        from nurbseg.app.command.config_file import format_config

        sys.stdout.write(format_config(arguments.config))
        return DONE
    levels = {-1: logging.WARNING, 0: logging.INFO, 1: logging.DEBUG}
    logging.getLogger("nurbseg").setLevel(levels[arguments.verbosity])
    with Interruption() as interruption:
        try:
            # At once: it imports its libraries while this process imports others.
            with ChildProcess("nurbseg.drivers.process.program") as source_process:
                return _run(arguments, interruption, source_process)
        except KeyboardInterrupt:
            pass
        except Exception:
            # Libraries sometimes turn an interruption into another error.
            if interruption.signal_number is None:
                _log.exception("unexpected failure")
                return FAILED
        return interruption.exit_code


def _run(arguments: Arguments, interruption: Interruption, source_process: ChildProcess) -> int:
    # Late, so that --help does not wait for numpy and OpenCV.
    from nurbseg.app.settings.output_config import dated
    from nurbseg.app.view.opening import begin_view, chosen_view

    config = arguments.config
    unread = set(changed_paths(config.segmentation))
    if config.depth.smoothing == "bilateral" or config.depth.average_frames > 1:
        # Both allow for the sensor's noise.
        unread.discard("extended.inverse_depth_noise")
    warn_of_unread(sorted(unread), [config.segmentation.method])
    # A user at a terminal who writes no files wants to see something.
    interactive = sys.stderr.isatty() and config.view.save is None and config.export.directory is None
    view = replace(config.view, save=config.view.save and dated(config.view.save))
    verbose = arguments.verbosity > 0
    try:
        config = replace(config, view=chosen_view(view, interactive=interactive))
        if config.explain.what is not None:
            return _explained(config, source_process, verbose=verbose)
        view_process = begin_view(config.shown)
    except ViewError as err:
        _log.error("%s", err, exc_info=verbose)
        return NOT_STARTED
    with view_process or nullcontext():
        # While the processes start.
        from nurbseg.app.live.run import SetupError, run
        from nurbseg.common.errors import DriverError

        try:
            with _logged_compilation(config):
                report = run(config, interruption, source_process, view_process)
        except SetupError as err:
            _log.error("%s", err, exc_info=verbose)
            return NOT_STARTED
        except (DriverError, ExportError, FrameFailedError, PublishError, ViewError) as err:
            _log.error("%s", err, exc_info=verbose)
            interruption.check()
            return FAILED
    _log.info("done: %s", report.summary())
    for what, where in (
        ("results", config.export.directory),
        ("recording to look at", config.view.save),
        ("report", config.export.report),
    ):
        if where is not None:
            _log.info("%s: %s", what, where)
    return DONE


def _logged_compilation(config: AppConfig) -> AbstractContextManager[None]:
    """Log the progress of compiling; a run that only records compiles nothing."""
    if config.record.only:
        return nullcontext()
    from nurbseg.app.command.compilation import logged_compilation

    return logged_compilation()


def _explained(config: AppConfig, source_process: ChildProcess, *, verbose: bool) -> int:
    from nurbseg.app.live.snapshot import explain
    from nurbseg.common.errors import DriverError

    try:
        with _logged_compilation(config):
            explain(config, source_process)
    except (DriverError, OSError, ValueError) as err:
        _log.error("%s", err, exc_info=verbose)
        return NOT_STARTED
    return DONE


if __name__ == "__main__":
    command()
