"""The exceptions of this package: one root, one clear line each."""

from __future__ import annotations

import sysconfig
from pathlib import Path
from traceback import extract_tb

_LONGEST = 600  # characters of a message


def one_line(text: str, length: int = _LONGEST) -> str:
    """The text on one line of bounded length: control characters are escaped, the middle of a long text is left out."""
    if len(text) > length:
        text = f"{text[: 2 * length // 3]} … {text[-(length // 3) :]}"
    return "".join(c if c.isprintable() else " " if c in "\n\t" else repr(c)[1:-1] for c in text).strip()


def text_of(error: BaseException) -> str:
    """An exception's message; empty if its ``__str__`` fails."""
    try:
        return str(error)
    except Exception:  # noqa: BLE001 (a third-party class)
        return ""


#: Where code is that nobody mends for a back end of their own, beside installed packages.
_OURS = (str(Path(__file__).parents[1] / name) for name in ("slam", "backends", "frontends"))
_LIBRARIES = ("<", sysconfig.get_path("stdlib"), *_OURS)


def cause(error: BaseException) -> str:
    """An exception of third-party code in words, with the last line of it, be it in a call of a library or of ours."""
    frames = extract_tb(error.__traceback__)
    theirs = [at for at in frames if not at.filename.startswith(_LIBRARIES) and "-packages" not in at.filename]
    place = (theirs or frames)[-1]
    text = f": {said}" if (said := text_of(error)) else ""
    return f"{type(error).__name__}{text} ({Path(place.filename).name}, line {place.lineno})"


class SlamError(Exception):
    """Root of every exception that this package raises on purpose.

    The message is always a single line that says what is wrong and where. Commands print it and exit with status 2.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class ConfigurationError(SlamError):
    """A setting has an unknown key, a wrong type, or a value outside its range."""


class UnknownNameError(SlamError):
    """A back end, front end, sequence or format of this name is not known."""


class CalibrationError(SlamError):
    """A camera calibration is missing, unreadable, not finite, or physically impossible."""


class SequenceError(SlamError):
    """A recorded sequence, or one frame of it, is missing, unreadable or inconsistent."""


class TrajectoryError(SlamError):
    """A trajectory cannot be read, written or compared."""


class MeasurementError(SlamError):
    """Measurements handed to an estimator break the contract (shape, ids, NaN, time running backwards)."""


class CopyError(SlamError, TypeError):
    """An object can be neither copied nor pickled; the message says what to do instead."""


class AnswerError(SlamError):
    """A back end or front end returned something else than its protocol says."""


class PartError(SlamError):
    """A third-party back end or front end raised an exception of its own, which is the ``__cause__``."""
