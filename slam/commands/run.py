"""``slam run``: what the command line and the ``config.json`` of an earlier run together ask for."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slam.config import SystemConfig
from slam.errors import ConfigurationError
from slam.outputs import Output
from slam.run import drawing
from slam.run import viewer as viewing
from slam.run.repeat import Origin, Repeat, changed_versions, load, versions
from slam.run.runner import RunOptions, parse_frames
from slam.sequences import Sequence as StereoSequence
from slam.sequences import open_sequence

_BACKEND, _FRONTEND = "ekf", "surf"


@dataclass(frozen=True)
class Wanted:
    """What a command line says; None where it says nothing.

    Attributes:
        sequence: as `slam.open_sequence` takes it.
        config: ``config.json`` of an earlier run, whose choices hold where nothing else is said.
        backend, frontend: names.
        settings: ``section.key=value``.
        frames: ``A:B``.
        kind: of motion.
        format: of the sequence.
        prior_map: file of a map to start in.
        mono: whether to use the left images alone.
        calibration: file with what is known of the rig's error.
    """

    sequence: str | None
    config: Path | None = None
    backend: str | None = None
    frontend: str | None = None
    settings: Sequence[str] = ()
    frames: str | None = None
    kind: str | None = None
    format: str | None = None
    prior_map: Path | None = None
    mono: bool = False
    calibration: Path | None = None


def prepare(wanted: Wanted) -> tuple[StereoSequence, RunOptions, Origin]:
    """The sequence, opened, and what to do with it; the folder is still to be chosen.

    Raises:
        SlamError: bad input; one line says what and where.
    """
    before = (
        None if wanted.config is None else load(wanted.config, wanted.sequence, wanted.prior_map, wanted.calibration)
    )
    if before is not None and wanted.kind is not None:
        raise ConfigurationError("--kind does not go with --config: settings of a kind of motion are already in it")
    text = wanted.sequence if before is None else before.origin.sequence
    if not text and wanted.sequence is None:
        raise ConfigurationError("name a sequence (see `slam list`), or --config FILE of an earlier run")
    same = before is not None and wanted.sequence is None  # a given sequence has a format of its own
    format = wanted.format or (before.origin.format if before is not None and same else None)
    opened = open_sequence(text or "", format=format)
    frontend = wanted.frontend or (before.frontend if before is not None else _FRONTEND)
    backend = wanted.backend or (before.backend if before is not None else _BACKEND)
    mono = wanted.mono or (before is not None and before.origin.mono)
    prior_map = wanted.prior_map or (before.origin.prior_map if before is not None else None)
    calibration = wanted.calibration or (before.origin.calibration if before is not None else None)
    if mono and prior_map is None:
        raise ConfigurationError("--mono needs --map FILE: left images alone do not tell how large the world is")
    kind = wanted.kind or (opened.kind if before is None else before.origin.kind)
    config = SystemConfig.for_kind(kind, frontend, backend)
    if before is not None:
        config = _repeated(before, config, frontend, backend)
    config = config.with_settings([*(["map.monocular=true"] if mono else []), *wanted.settings])
    start, stop = (before.start, before.stop) if before is not None else (0, None)
    if wanted.frames is not None:
        start, stop = parse_frames(wanted.frames)
    options = RunOptions(backend, frontend, config, Path(), start, stop, prior_map=prior_map, mono=mono)
    options = replace(options, calibration=calibration)
    return opened, options, Origin(command_line(), text or "", format, kind, prior_map, mono, calibration)


def shown(draw: Path | None, viewer: str | None) -> list[Output]:
    """What is written for people who watch: pictures or a video, and a file for Rerun."""
    pictures = [] if draw is None else [drawing.output(draw)]
    return pictures + ([] if viewer is None else viewing.outputs(viewer, "--viewer"))


def _repeated(before: Repeat, default: SystemConfig, frontend: str, backend: str) -> SystemConfig:
    """The settings of an earlier run; options of another front end or back end than its are the defaults."""
    changed = changed_versions(before.versions, versions())
    if changed:
        logging.getLogger(__name__).warning("made with other versions, results may differ: %s", changed)
    return replace(
        before.config,
        frontend=before.config.frontend if frontend == before.frontend else default.frontend,
        backend=before.config.backend if backend == before.backend else default.backend,
    )


def command_line() -> str:
    """The command that is running, as it can be typed again."""
    return shlex.join(["slam", *sys.argv[1:]])
