"""Effects of the commands on a run."""

import logging
import threading
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any

from nurbseg.app.control.commands import RunState, help_text
from nurbseg.app.recording.recorder import Recorder, RecordError
from nurbseg.common.settings import choices, from_text, not_one_of, setting_paths, updated
from nurbseg.drivers.process.client import SourceProcess
from nurbseg.segmentation.config import SegmentationConfig

_log = logging.getLogger(__name__)

#: Commands of a run that only records.
_OF_RECORDING = ("record", "loop", "speed", "faster", "slower", "help", "quit")
#: The settings that commands change.
_SETTINGS = {
    "method": "method",
    "metric": "metric",
    "ratio": "ratio_max",
    "lambda": "geometry_weight",
    "depth-max": "depth_max",
    "piece-pixels": "extended.piece_pixels_min",
    "level": "extended.level",
}
#: Changes of the speed of a replay, and of the ratio, by a key.
_SPEED_FACTOR, _RATIO_STEP = 1.5, 0.05


class Controls:
    """Executes commands, those of other threads also while a frame is segmented.

    `fixed` says why the settings must not change, and is empty if they may; `segments` whether frames are
    segmented, not only recorded.
    """

    def __init__(
        self,
        config: SegmentationConfig,
        source: SourceProcess,
        recorder: Recorder,
        *,
        fixed: str = "",
        segments: bool = True,
    ) -> None:
        #: Settings for the following frames.
        self.config = config
        #: Whether the run is to end.
        self.ended = self._closed = False
        #: What is to be written of the next frame: "snapshot", "explain".
        self.wanted: set[str] = set()
        #: The page of the newest explanation; empty before the first.
        self.explained = ""
        #: Called after each command, by the thread that has executed it.
        self.changed: Callable[[], None] = lambda: None
        #: Why a command of another thread has failed, which the run raises.
        self.error: BaseException | None = None
        self.recorder = recorder
        self._source, self._fixed, self._segments = source, fixed, segments
        #: Held while a command is executed.
        self._executing = threading.Lock()
        #: What the last command has said, and whether it was refused; the newest command of the page.
        self._said, self._answered = ("", False), 0
        self._commands: dict[str, Callable[[str], str]] = {
            "pause": lambda _: self._pause(not source.paused),
            "resume": lambda _: self._pause(False),
            "step": lambda _: self._step(),
            "seek": self._seek,
            "loop": self._loop,
            "record": self._record,
            "speed": lambda word: self._set_speed(_number(word)),
            "faster": lambda _: self._set_speed((source.speed or 0) * _SPEED_FACTOR),
            "slower": lambda _: self._set_speed((source.speed or 0) / _SPEED_FACTOR),
            "snapshot": lambda _: self._want("snapshot", "writing this frame"),
            "explain": lambda _: self._want("explain", "explaining this frame"),
            "help": lambda _: help_text(),
            "quit": lambda _: self._quit(),
        }

    @property
    def is_over(self) -> bool:
        """Whether the run only records, and its recording failed."""
        recording = self.recorder.recording
        return not self._segments and recording is not None and bool(recording.failure)

    def state(self) -> RunState:
        """Return what these commands decide of the run's state."""
        # First: what was decided later may be missing, but nothing that was answered.
        answered, (said, refused) = self._answered, self._said
        may_seek = self._source.seekable and not self._fixed and not self.recorder.is_recording
        return RunState(
            self.config,
            fixed=self._fixed,
            paused=self._source.paused,
            seekable=may_seek or None,
            said=said,
            refused=refused,
            answered=answered,
            explained=self.explained,
        )

    def ask(self, command: str, number: int = 0) -> None:
        """Execute a command of another thread, until `close`."""
        try:
            if not self._closed:
                self.apply(command, number)
        except BaseException as err:
            self.error = err

    def close(self) -> None:
        """Ignore further commands of other threads."""
        self._closed = True

    def apply(self, command: str, number: int = 0) -> None:
        """Execute a command, of the page if it has a number, and log its effect or what is wrong with it."""
        with self._executing:
            try:
                said = self._executed(command)
            except ValueError as err:
                self.say(str(err), refused=True)
            else:
                self.say(said)
            self._answered = number or self._answered
        self.changed()

    def _executed(self, command: str) -> str:
        """Execute a command and return its effect; raises ValueError if it is refused."""
        name, _, word = command.partition(" ")
        name, word = "ratio" if name == "T" else name, word.strip()
        if name not in self._commands and name not in _SETTINGS:
            raise ValueError(f"{name[:80]!r} is not a command; help lists them")
        try:
            if not self._segments and name not in _OF_RECORDING:
                raise ValueError("--record-only segments and shows nothing")
            return self._set(name, word) if name in _SETTINGS else self._commands[name](word)
        except ValueError as err:
            # A setting may be named as the command is.
            raise ValueError(f"{name}: {str(err).removeprefix(f'{name}: ')}") from err

    def say(self, text: str, *, refused: bool = False) -> None:
        """Log what a command has to say, and keep it for the state."""
        self._said = text, refused
        if text:
            _log.log(logging.WARNING if refused else logging.INFO, "%s", text)

    def _pause(self, paused: bool) -> str:
        self._source.play(paused=paused)
        return "paused" if paused else "resumed"

    def _step(self) -> str:
        self._source.step()
        return ""

    def _seek(self, word: str) -> str:
        source = self._source
        if not source.seekable:
            raise ValueError("a camera cannot seek")
        if self._fixed:
            raise ValueError("exporting needs the frames in order")
        if self.recorder.is_recording:
            raise ValueError("recording needs the frames in order; stop it first")
        try:
            number = int(word)
        except ValueError:
            raise ValueError(f"expected a frame's number, +N or -N, got {word[:80]!r}") from None
        source.seek(source.position + number if word[0] in "+-" else number)
        return f"to frame {source.position}"

    def _loop(self, word: str) -> str:
        if self._source.loop is None:
            raise ValueError("only a replay can loop")
        chosen = _chosen(word, "on" if self._source.loop else "off", ("on", "off"))
        self._source.play(loop=chosen == "on")
        return f"loop {chosen}"

    def _record(self, word: str) -> str:
        recorder = self.recorder
        now = "on" if recorder.is_recording else "off"
        if _chosen(word, now, ("on", "off")) == "off":
            if recorder.recording is None:
                raise ValueError("nothing is being recorded")
            path = recorder.recording.path
            recorder.end()
            return f"recording ends: {path}"
        try:
            return f"recording to {recorder.begin()}"
        except RecordError as err:
            raise ValueError(str(err)) from err

    def _set_speed(self, speed: float) -> str:
        if self._source.speed is None:
            raise ValueError("speed applies only to replays at the recorded rate or a multiple of it")
        self._source.play(speed=speed)
        return f"speed {speed:.3g}"

    def _set(self, name: str, word: str) -> str:
        """Change a setting; without a word, one that has choices becomes the next, and the ratio rises."""
        if self._fixed:
            raise ValueError(self._fixed)
        path = _SETTINGS[name]
        if self.config.method == "stag15" and name == "level":
            raise ValueError("the method stag15 has surfaces only; change the method first")
        if self.config.method == "stag15" and name == "piece-pixels":
            path = "stag15.segment_pixels_min"
        field, now = _FIELDS[path], attrgetter(path)(self.config)
        if choices(field):
            value = _chosen(word, now, choices(field))
        elif name == "ratio" and not word:
            value = round(now + _RATIO_STEP, 2)
            value = 0.7 if value > 1.3 else value
        else:
            value = from_text(field, word)
        try:
            self.config = updated(self.config, **{path: value})
        except ValueError as err:
            # A setting is not called as the command is.
            raise ValueError(str(err).partition(": ")[2]) from None
        return f"{name} {attrgetter(path)(self.config)}"

    def _want(self, what: str, said: str) -> str:
        self.wanted.add(what)
        return said

    def _quit(self) -> str:
        self.ended = True
        return "quit"


_FIELDS = dict(setting_paths(SegmentationConfig))


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"expected a number, got {word[:80]!r}") from None


def _chosen(word: str, now: str, choices: Sequence[str]) -> Any:
    """Return the choice that a word names, in any case; without a word the one after the current one."""
    word = word.lower()
    if word and word not in choices:
        raise ValueError(not_one_of(choices, word))
    return word or choices[(choices.index(now) + 1) % len(choices)]
