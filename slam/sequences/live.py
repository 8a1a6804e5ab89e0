"""Frames at their own rate, as a camera gives them: the newest counts, what came before it unseen is dropped."""

from __future__ import annotations

import atexit
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator

from slam.data import StereoFrame
from slam.sequences.base import Sequence, is_live

_LOOK = 0.05  # [s] between two looks whether the end was asked for
_PARTING = 1.0  # [s] that the thread is waited for; a driver may hold it for longer
_REMEMBERED = 16  # frames whose arrival is known


class LiveFrames:
    """Frames at their own rate: each comes at the time of its stamp, and only the newest one waits; iterate once.

    A second thread reads them. If processing is too slow, frames are dropped, so that it is never behind by more than
    the frame in work. If reading is slower than the frames' rate, their clock waits.

    Args:
        frames: a sequence, or frames in order of time.
        paced: hold each frame back until it is due by its stamp; default: unless they come from a camera.
        until: the frames end when it is set, also while the next one is waited for.

    Attributes:
        dropped: number of frames that were replaced by a newer one before they were taken.

    Examples:
        >>> import slam
        >>> sequence = slam.open_sequence("synthetic:desk?frames=3&width=160&height=120")
        >>> live = slam.LiveFrames(sequence)
        >>> system = slam.StereoSlam(sequence.rig)
        >>> done = [result.status for frame, result in system.run(live)]
        >>> len(done) + live.dropped
        3
    """

    live = True  # `StereoSlam.run` then extracts no frame before it can be used

    def __init__(
        self, frames: Sequence | Iterable[StereoFrame], paced: bool | None = None, until: threading.Event | None = None
    ) -> None:
        self.dropped = 0
        self._frames = frames
        self._paced = not is_live(frames) if paced is None else paced
        self._until = until or threading.Event()  # only read: it is the caller's
        self._closed = False
        self._changed = threading.Condition()
        self._newest: tuple[StereoFrame, float] | None = None  # and when it came, by the clock of `time.monotonic`
        self._arrivals: deque[tuple[int, float]] = deque(maxlen=_REMEMBERED)
        self._over = False
        self._error: BaseException | None = None

    def __iter__(self) -> Iterator[StereoFrame]:
        thread = threading.Thread(target=self._read, name="live frames", daemon=True)

        def end() -> None:
            self._closed = True
            thread.join(_PARTING)

        thread.start()
        atexit.register(end)  # a thread that runs on while Python is taken down may hang or abort it
        try:
            while (frame := self._take()) is not None:
                yield frame
            if self._error is not None:
                raise self._error
        finally:
            atexit.unregister(end)
            end()

    def age(self, frame: StereoFrame) -> float:
        """How long ago a frame came [s], for the frames taken last; NaN for others."""
        now = time.monotonic()
        return next((now - since for index, since in self._arrivals if index == frame.index), float("nan"))

    def _take(self) -> StereoFrame | None:
        """The newest frame, waited for; None at the end, before which the last frame is still given."""
        with self._changed:
            while self._newest is None and not self._over and not self._until.is_set():
                self._changed.wait(_LOOK)
            newest, self._newest = self._newest, None
            if newest is None or self._until.is_set():
                return None
            self._arrivals.append((newest[0].index, newest[1]))
            return newest[0]

    def _read(self) -> None:
        """Put every frame where it is taken from when it is due, until the last one or the end; in a thread."""
        frames, origin = None, None
        try:
            frames = iter(self._frames)
            for frame in frames:
                if self._paced:
                    now = time.monotonic()
                    origin = now - frame.stamp if origin is None else origin
                    origin = max(origin, now - frame.stamp)  # the clock waits for reading
                    while (rest := origin + frame.stamp - time.monotonic()) > 0 and not self._ending():
                        time.sleep(min(rest, _LOOK))
                if self._ending():
                    break
                with self._changed:
                    self.dropped += self._newest is not None
                    self._newest = frame, time.monotonic()
                    self._changed.notify_all()
        except BaseException as error:  # noqa: BLE001 - it is raised in the caller's thread
            self._error = error
        finally:
            if (close := getattr(frames, "close", None)) is not None:
                close()  # a camera is released in the thread that reads it
            with self._changed:
                self._over = True
                self._changed.notify_all()

    def _ending(self) -> bool:
        return self._closed or self._until.is_set()
