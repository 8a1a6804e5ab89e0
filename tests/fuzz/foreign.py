"""Back ends from elsewhere that raise, exit or answer nonsense in mid-run: one line, and what was done is kept."""

from __future__ import annotations

import csv
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import backends
from slam.config import SystemConfig
from slam.errors import PartError, SlamError
from slam.geometry.trajectory import Trajectory
from slam.run.recorded import record
from slam.run.replay import replay
from slam.run.runner import RunOptions, run
from slam.system import StereoSlam
from tests.fuzz.harness import Broken, Subject, require_line
from tests.fuzz.hostile import VALUES, choose
from tests.fuzz.runs import FRAMES, Scripted, _Frontend, require_whole
from tests.fuzz.settings import scene

_CALLS = ("predict", "update", "add", "remove", "estimate", "positions", "trajectory")
_MORE = ("insert", "place", "revise")
_ERRORS: tuple[BaseException, ...] = (
    ZeroDivisionError("no way"), ValueError(), KeyError("x"), StopIteration(), RuntimeError("two\nlines"),
    SystemExit(3),
    np.linalg.LinAlgError("singular"), MemoryError(), OSError(28, "No space left"), AssertionError("é" * 5000),
    RecursionError(), NotImplementedError("later"), TypeError("x() takes 2"), BrokenPipeError(), AttributeError("y"),
)  # fmt: skip


class _Foreign:
    """A back end that another one does the work for, until a call goes wrong.

    Args:
        backend: the other one.
        rng: decides.
        chance: that a call goes wrong.
        offered: methods beyond those of every back end.
    """

    revises_path = True

    def __init__(self, backend: Any, rng: np.random.Generator, chance: float, offered: tuple[str, ...]) -> None:
        self.backend, self.rng, self.chance = backend, rng, chance
        for name in (*_CALLS, *offered):
            setattr(self, name, _Call(self, name))


class _Call:
    """One of its methods."""

    def __init__(self, owner: _Foreign, name: str) -> None:
        self.owner, self.name = owner, name

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        rng, wrong = self.owner.rng, self.owner.rng.random() < self.owner.chance
        if wrong and rng.random() < 0.3:
            raise choose(rng, _ERRORS)
        answer = getattr(self.owner.backend, self.name)(*arguments, **options)
        return _spoilt(rng, answer) if wrong else answer


def _spoilt(rng: np.random.Generator, answer: Any) -> Any:
    """Another answer: of another type, or with one part of another type, shape or value."""
    if not is_dataclass(answer) or rng.random() < 0.1:
        return _other(rng, answer)
    name = choose(rng, [field.name for field in fields(answer)])
    try:
        return replace(answer, **{name: _other(rng, getattr(answer, name))})  # type: ignore[type-var]
    except (SlamError, ValueError, TypeError, AttributeError):  # it checks itself
        return None


def _other(rng: np.random.Generator, value: Any) -> Any:
    if not isinstance(value, np.ndarray) or rng.random() < 0.15:
        return choose(rng, VALUES)
    kind = int(rng.integers(7))
    if kind == 0:
        return choose(rng, (value[:-1], value[:1], np.concatenate([value, value]), value[::-1], value[None], value.T))
    if kind == 1:
        return value.astype(choose(rng, (np.float32, np.int64, "U8", object, complex, bool, ">f8")))
    if kind == 2:
        return value.tolist()
    out = np.array(value, float if kind > 4 else value.dtype)
    if out.size:
        with np.errstate(all="ignore"):
            number = choose(rng, (np.nan, np.inf, -np.inf, 0, -1, 1, 1e300, -1e9, 1e-300, 2**62))
            if out.dtype.kind != "f":
                number = int(np.nan_to_num(np.clip(number, -(2**62), 2**62)))
            out[rng.random(out.shape) < choose(rng, (0.1, 1.0))] = number
    return out


def made(*_: Any, **__: Any) -> Any:
    """Stands for the back end of a run, which is given by name."""


def failing(rng: np.random.Generator, folder: Path) -> None:
    """A run, a system or a replay with such a back end."""
    rig, frames = scene()
    name = choose(rng, ("ekf", "ekf", "smoother"))
    offered = tuple(m for m in _MORE if rng.random() < 0.5)
    mine: Any = _Foreign(backends.create(name, rig), rng, choose(rng, (0.005, 0.03, 0.2)), offered)
    way = int(rng.integers(3))
    if way == 0:
        _run(mine, folder)
        return
    if way == 1:
        system = StereoSlam(rig, None, mine)
        for call in (*(lambda f=f: system.process_features(f) for f in frames), system.estimate, system.trajectory,
                     system.roll_back, system.snapshot):  # fmt: skip
            _attempt(call)
        return
    own = StereoSlam(rig, None, "ekf")
    recording = record([own.process_features(f) for f in frames], rig, own.config.models)
    _attempt(lambda: list(replay(recording, mine)))


def _attempt(call: Any) -> None:
    try:
        call()
    except SlamError as error:
        _require_chained(error)


def _require_chained(error: SlamError) -> None:
    require_line(error)
    if isinstance(error, PartError) and error.__cause__ is None:
        raise Broken("the cause is lost")


def _run(mine: Any, folder: Path) -> None:
    """A run with its files: the rows of the frames before are whole."""
    out, done = folder / "out", []
    sequence: Any = Scripted(None, 0)
    options = RunOptions(
        f"{__name__}:made", "none", SystemConfig(), out, record=folder / "a.npz", save_map=folder / "a.map"
    )
    try:
        with patch(f"{__name__}.made", lambda *_, **__: mine):
            run(sequence, options, lambda r: done.append(r.index), frontend=_Frontend())  # type: ignore[arg-type]
    except SlamError as error:
        _require_chained(error)
    require_whole(folder, out)
    with (out / "frames.csv").open(newline="") as file:
        if len(list(csv.reader(file))) - 1 < len(done):
            raise Broken("a row is lost")
    if len(done) > FRAMES or (done and len(Trajectory.read_tum(out / "trajectory.txt")) < len(done)):
        raise Broken("a pose is lost")


SUBJECTS = (
    Subject("back ends from elsewhere", "back ends that raise, exit or answer nonsense, in systems, runs and replays",
            "a result or one line chained from its cause; whole files", failing, quiet=False, short=30),
)  # fmt: skip
