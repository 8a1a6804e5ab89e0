"""What a comparison runs: sequences × back ends × seeds, in pairs that differ in the back end alone."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass

from slam.errors import ConfigurationError

SYNTHETIC = "synthetic:"

#: Measurements straight from a world's landmarks in place of a front end's: no image is made.
SIMULATED = "simulated"

CLOSED_LOOP, REPLAY = "closed loop", "replay"


@dataclass(frozen=True)
class Plan:
    """All of a comparison.

    Attributes:
        sequences: as `slam.open_sequence` takes them.
        backends: names; differences are taken from the first.
        frontend: a name, or `SIMULATED`.
        settings: ``section.key=value``, applied in their order.
        trials: seeds 0, 1, … of every synthetic world; recorded sequences have one trial.
        start, stop: range of frames.
        replay: besides the closed loop, feed the first back end's measurements to every back end.

    Raises:
        ConfigurationError: nothing to run, a name stands twice, or a world's seed is given although trials choose it.
    """

    sequences: tuple[str, ...]
    backends: tuple[str, ...]
    frontend: str = "surf"
    settings: tuple[str, ...] = ()
    trials: int = 1
    start: int = 0
    stop: int | None = None
    replay: bool = False

    def __post_init__(self) -> None:
        for what, every in {"sequence": self.sequences, "back end": self.backends}.items():
            if not every:
                raise ConfigurationError(f"comparison: no {what} is given")
            twice = next((name for name in every if every.count(name) > 1), None)
            if twice is not None:
                raise ConfigurationError(f"comparison: {what} {twice!r} is given twice")
        if self.trials < 1:
            raise ConfigurationError(f"comparison: trials must be 1 or more, got {self.trials}")
        for sequence in self.sequences:
            if sequence.startswith("camera:"):
                raise ConfigurationError(f"{sequence}: a camera gives each back end other frames; compare recordings")
            if is_world(sequence) and re.search(r"[?&]seed=", sequence):
                raise ConfigurationError(f"{sequence}: leave the seed out, the trials have seeds 0 to N − 1")
            if not is_world(sequence) and self.frontend == SIMULATED:
                raise ConfigurationError(f"{sequence}: front end {SIMULATED!r} is for synthetic worlds alone")

    def trials_of(self, mode: str) -> Iterator[Trial]:
        """All trials of a mode, in the order of the tables."""
        shared = self.frontend, self.settings, mode, self.start, self.stop
        for sequence in self.sequences:
            for seed in range(self.trials if is_world(sequence) else 1):
                for backend in self.backends:
                    yield Trial(sequence, backend, seed, *shared)

    @property
    def modes(self) -> tuple[str, ...]:
        """Closed loop, and replay where it is asked for."""
        return (CLOSED_LOOP, REPLAY) if self.replay else (CLOSED_LOOP,)

    @property
    def every(self) -> list[Trial]:
        """All trials, mode by mode."""
        return [trial for mode in self.modes for trial in self.trials_of(mode)]


@dataclass(frozen=True)
class Trial:
    """One run."""

    sequence: str  # as the plan has it
    backend: str
    seed: int = 0  # of the recording of a synthetic world; 0 for recorded sequences
    frontend: str = "surf"
    settings: tuple[str, ...] = ()
    mode: str = CLOSED_LOOP
    start: int = 0
    stop: int | None = None

    @property
    def source(self) -> str:
        """The sequence's text, with the seed where it is a world."""
        if not is_world(self.sequence):
            return self.sequence
        return f"{self.sequence}{'&' if '?' in self.sequence else '?'}seed={self.seed}"

    @property
    def folder(self) -> str:
        """Where its files go, below the comparison's ``runs``."""
        names = (_short_name(self.sequence), f"seed_{self.seed}", _short_name(self.backend))
        return "/".join((*names, self.mode.replace(" ", "_")))


def is_world(sequence: str) -> bool:
    """Whether a sequence is a synthetic world."""
    return sequence.startswith(SYNTHETIC)


def _short_name(text: str) -> str:
    """A file name for a text: readable, and its own even where only odd characters or a long path tell two apart."""
    plain = re.sub(r"[^A-Za-z0-9.]+", "_", text.removeprefix(SYNTHETIC)).strip("_")
    if plain == text.removeprefix(SYNTHETIC) and len(plain) <= 60:
        return plain
    return f"{plain[-48:].strip('_')}_{hashlib.sha256(text.encode()).hexdigest()[:8]}"
