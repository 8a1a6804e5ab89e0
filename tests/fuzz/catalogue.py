"""All classes of inputs."""

from __future__ import annotations

from tests.fuzz import agreement, bookkeeping, commands, library, readers, runs, saved, settings, values

SUBJECTS = tuple(
    subject
    for module in (readers, settings, saved, commands, runs, values, library, agreement, bookkeeping)
    for subject in module.SUBJECTS
)
