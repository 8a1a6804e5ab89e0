"""All classes of inputs."""

from __future__ import annotations

from tests.fuzz import agreement, bags, bookkeeping, commands, library, readers, runs, saved, settings, values

SUBJECTS = tuple(
    subject
    for module in (readers, bags, settings, saved, commands, runs, values, library, agreement, bookkeeping)
    for subject in module.SUBJECTS
)
