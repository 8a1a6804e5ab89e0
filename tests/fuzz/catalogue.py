"""All classes of inputs."""

from __future__ import annotations

from tests.fuzz import agreement, bookkeeping, commands, library, live, readers, runs, saved, settings

SUBJECTS = (
    *readers.SUBJECTS,
    *settings.SUBJECTS,
    *saved.SUBJECTS,
    *commands.SUBJECTS,
    *runs.SUBJECTS,
    *library.SUBJECTS,
    *live.SUBJECTS,
    *agreement.SUBJECTS,
    *bookkeeping.SUBJECTS,
)
