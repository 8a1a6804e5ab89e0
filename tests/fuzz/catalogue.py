"""All classes of inputs."""

from __future__ import annotations

from tests.fuzz import agreement, bookkeeping, commands, foreign, library, readers, runs, saved, settings, values

SUBJECTS = tuple(
    subject
    for module in (readers, settings, saved, commands, runs, values, library, foreign, agreement, bookkeeping)
    for subject in module.SUBJECTS
)
