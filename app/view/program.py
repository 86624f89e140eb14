"""The program that shows and saves frames for another process.

It ends on request, or when the other process has ended, after the frames received until then.
"""

import contextlib
import ctypes
import logging
import os
import signal

from nurbseg.app.view.drawing.frame import ViewFrame
from nurbseg.app.view.messages import CODEC, Close, Closed, Failed, Line, Open, Status
from nurbseg.app.view.rerun import RerunView
from nurbseg.app.view.viewer import FILE_PATIENCE_S, ViewError
from nurbseg.drivers.process.channel import Channel, ChannelClosedError, LogForwarder, connect_to_parent

#: Time between two checks of the viewer, seconds.
_LOOK_S = 0.1
#: Longest wait for the first message, seconds: the run may wait for its source.
_BEGIN_S = 3600.0
#: Time limit for ending after the other process has ended, seconds.
_END_S = 2.0 * FILE_PATIENCE_S
#: By how much this process is less urgent than the segmentation, which otherwise waits for it on two cores.
_LESS_URGENT = 4
#: Parameter of glibc's `mallopt`: maximum number of heaps.
_M_ARENA_MAX = -8


def _handle_messages(view: RerunView, channel: Channel) -> float:
    """Handle messages until the last one; return the time limit for completing a file, seconds."""
    sent = Status(0, 0)
    while True:
        if (status := view.status()) != sent:
            channel.send(status)
            sent = status
        message = channel.receive(_LOOK_S)
        try:
            if isinstance(message, ViewFrame):
                view.show(message)
            elif isinstance(message, Line):
                view.show_line(message)
            elif isinstance(message, Close):
                return message.file_limit_s
            # After the message, which a stuck disk would lose.
            view.look_after()
        except ViewError as err:
            channel.send(Failed(str(err)))
        except Exception as err:
            channel.send(Failed(f"a frame cannot be shown ({type(err).__name__}): {err}"))


def _share_one_heap() -> None:
    """Let all threads share one heap: arrays pass between threads, and several heaps would each grow."""
    with contextlib.suppress(OSError, AttributeError):  # Another C library has no such heaps.
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)


def _run(channel: Channel) -> int:
    message = channel.receive(_BEGIN_S)
    if not isinstance(message, Open):
        return 1
    logging.getLogger().addHandler(LogForwarder(channel))
    logging.getLogger("nurbseg").setLevel(message.log_level)
    try:
        view = RerunView(message)
    except ViewError as err:
        channel.send(Failed(str(err)))
        return 1
    limit_s = FILE_PATIENCE_S
    with contextlib.suppress(ChannelClosedError):
        channel.send(view.opened)
        limit_s = _handle_messages(view, channel)
    try:
        view.close(file_limit_s=limit_s)
    except ViewError as err:
        channel.send(Failed(str(err)))
    channel.send(view.status())
    channel.send(Closed())
    return 0


def main() -> int:
    """Show and save what the channel delivers."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # The other process ends this one. Not SIG_IGN, which a viewer started here would inherit.
        signal.signal(number, lambda *_: None)
    os.nice(_LESS_URGENT)
    _share_one_heap()
    try:
        return _run(connect_to_parent(CODEC, limit_s=_END_S))
    except ChannelClosedError:
        return 0


if __name__ == "__main__":
    # Not sys.exit: a stuck thread of a library would keep the process alive forever.
    os._exit(main())
