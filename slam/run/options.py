"""What to run, with what, and where the files go; and what the run's ``config.json`` says of it."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from slam.config import SystemConfig
from slam.errors import SlamError
from slam.outputs import Output
from slam.run.schema import FILES

_MOST_FRAMES = 10**12  # of a sequence: more than any has
_PACKAGES = ("surf-stereo-slam", "numpy", "scipy", "numba", "gtsam", "opencv-contrib-python-headless")


@dataclass(frozen=True)
class RunOptions:
    """What to run and where to leave the files."""

    backend: str
    frontend: str
    config: SystemConfig
    out: Path = Path()  # folder for the files
    start: int = 0
    stop: int | None = None  # range of frames; None for all
    record: Path | None = None  # file for a recording of what the back end is given, see `slam.run.replay`
    prior_map: Path | None = None  # file of a map to start in, see `slam.atlas.map_io`; None to begin a new one
    save_map: Path | None = None  # file for the map at the end
    calibration: Path | None = None  # file with what is known of the rig's error, see `slam.calibration.saved`
    mono: bool = False  # use the left images alone
    live: bool = False  # take frames at their own rate, and leave out those that come too late; of a camera always
    kind: str = ""  # of motion that the settings are for; empty where not known
    command: str = ""  # the command line, for ``config.json``

    @property
    def outputs(self) -> list[Output]:
        """What the run writes."""
        files = ((self.record, "--record"), (self.save_map, "--save-map"))
        given = (Output(path, option) for path, option in files if path is not None)
        return [Output(self.out, "--out", list(FILES)), *given]


def parse_frames(text: str | None) -> tuple[int, int | None]:
    """``A:B`` (either may be left out) as a range of frames; raises SlamError: not of that form."""
    if text is None:
        return 0, None
    first, colon, last = text.partition(":")
    try:
        if not colon:
            raise ValueError
        start, stop = int(first or 0), int(last) if last else None
    except ValueError:
        raise SlamError(f"frames {text!r} is not of the form A:B; 0:40 are the first 40") from None
    if start < 0 or max(start, stop or 0) > _MOST_FRAMES:
        raise SlamError(f"frames {text!r}: numbers of frames go from 0 to {_MOST_FRAMES}")
    return start, stop


def origin(options: RunOptions) -> dict[str, Any]:
    """What ``config.json`` says besides names: the command and where it was typed, kind, frames, settings, versions."""
    typed = {"command": options.command, "folder": str(Path.cwd())} if options.command else {}
    what = {"kind": options.kind, "frames": [options.start, options.stop], "versions": versions()}
    return typed | what | {"settings": options.config.to_json()}


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that shape a result."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found
