"""Effects of the commands on a run."""

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar, get_args

from nurbseg.app.control.commands import RunState, help_text
from nurbseg.app.recording.recorder import Recorder, RecordError
from nurbseg.common.settings import not_one_of, number
from nurbseg.drivers.process.client import SourceProcess
from nurbseg.segmentation.config import (
    ExtendedConfig,
    Level,
    Method,
    Metric,
    SegmentationConfig,
    Stag15Config,
)

_Section = TypeVar("_Section", SegmentationConfig, Stag15Config, ExtendedConfig)

_log = logging.getLogger(__name__)

#: Commands of a run that only records.
_OF_RECORDING = ("record", "loop", "speed", "faster", "slower", "help", "quit")
#: Names of settings in commands, where they differ.
_NAMES = {"ratio_max": "ratio", "geometry_weight": "lambda", "depth_max": "depth-max"}
#: Changes of the speed of a replay, and of the ratio, by a key.
_SPEED_FACTOR, _RATIO_STEP = 1.5, 0.05


class Controls:
    """Executes commands, also while a frame is segmented.

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
        self.ended = False
        #: Whether to write a snapshot of the next frame, and whether to explain it.
        self.snapshot = self.explanation = False
        #: The page of the newest explanation; empty before the first.
        self.explained = ""
        self.recorder = recorder
        self._source = source
        self._fixed = fixed
        self._segments = segments
        #: Held while a command is executed.
        self._executing = threading.Lock()
        #: What the last command has said, and whether it was refused; the newest command of the page.
        self._said, self._answered = ("", False), 0
        self._commands: dict[str, Callable[[str], str]] = {
            "pause": lambda _: self._pause(not self._source.paused),
            "resume": lambda _: self._pause(False),
            "step": lambda _: self._step(),
            "seek": self._seek,
            "loop": self._loop,
            "record": self._record,
            "speed": lambda word: self._set_speed(_number(word)),
            "faster": lambda _: self._set_speed((self._source.speed or 0) * _SPEED_FACTOR),
            "slower": lambda _: self._set_speed((self._source.speed or 0) / _SPEED_FACTOR),
            "metric": lambda word: self._change(metric=_chosen(word, self.config.metric, get_args(Metric))),
            "ratio": self._set_ratio,
            "T": self._set_ratio,
            "lambda": lambda word: self._change(geometry_weight=number(word)),
            "depth-max": lambda word: self._change(depth_max=number(word)),
            "piece-pixels": self._set_piece_pixels,
            "level": self._set_level,
            "method": lambda word: self._change(method=_chosen(word, self.config.method, get_args(Method))),
            "snapshot": lambda _: self._snapshot(),
            "explain": lambda _: self._explain(),
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

    def _executed(self, command: str) -> str:
        """Execute a command and return its effect; raises ValueError if it is refused."""
        name, _, word = command.partition(" ")
        if name not in self._commands:
            raise ValueError(f"{name[:80]!r} is not a command; help lists them")
        try:
            if not self._segments and name not in _OF_RECORDING:
                raise ValueError("--record-only segments and shows nothing")
            return self._commands[name](word.strip())
        except ValueError as err:
            # A setting may be named as the command is.
            raise ValueError(f"{name}: {str(err).removeprefix(f'{name}: ')}") from err

    def say(self, text: str, *, refused: bool = False) -> None:
        """Log what a command has to say, and keep it for the state."""
        self._said = text, refused
        if text:
            _log.log(logging.WARNING if refused else logging.INFO, "%s", text)

    def _pause(self, paused: bool) -> str:
        self._source.pause(paused)
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
        self._source.loop = chosen == "on"
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
            path = recorder.begin()
        except RecordError as err:
            raise ValueError(str(err)) from err
        return f"recording to {path}"

    def _set_speed(self, speed: float) -> str:
        if self._source.speed is None:
            raise ValueError("speed applies only to replays at the recorded rate or a multiple of it")
        self._source.speed = speed
        return f"speed {speed:.3g}"

    def _set_level(self, word: str) -> str:
        if self.config.method == "stag15":
            raise ValueError("the method stag15 has surfaces only; change the method first")
        level = _chosen(word, self.config.extended.level, get_args(Level))
        self._change(extended=replace(self.config.extended, level=level))
        return f"level {level}"

    def _set_ratio(self, word: str) -> str:
        value: Any = number(word) if word else round(self.config.ratio_max + _RATIO_STEP, 2)
        return self._change(ratio_max=0.7 if not word and value > 1.3 else value)

    def _set_piece_pixels(self, word: str) -> str:
        value = number(word)
        if self.config.method == "stag15":
            self._change(stag15=_changed(self.config.stag15, segment_pixels_min=value))
        else:
            self._change(extended=_changed(self.config.extended, piece_pixels_min=value))
        return f"piece-pixels {value}"

    def _change(self, **settings: Any) -> str:
        if self._fixed:
            raise ValueError(self._fixed)
        self.config = _changed(self.config, **settings)
        return ", ".join(f"{_NAMES.get(name, name)} {getattr(self.config, name)}" for name in settings)

    @property
    def wants_frame(self) -> bool:
        """Whether a frame is to be segmented for a snapshot or an explanation."""
        return self.snapshot or self.explanation

    def _explain(self) -> str:
        self.explanation = True
        return "explaining this frame"

    def _snapshot(self) -> str:
        self.snapshot = True
        return "writing this frame"

    def _quit(self) -> str:
        self.ended = True
        return "quit"


def _changed(section: _Section, **settings: Any) -> _Section:
    """Return changed settings; an error does not name the setting, which is not called as the command is."""
    try:
        return replace(section, **settings)
    except ValueError as err:
        raise ValueError(str(err).partition(": ")[2]) from None


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
