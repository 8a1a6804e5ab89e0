"""All classes of inputs."""

from __future__ import annotations

from tests.fuzz import agreement, aligning, bookkeeping, commands, library, live, readers, runs, saved, settings

SUBJECTS = (
    *readers.SUBJECTS,
    *settings.SUBJECTS,
    *saved.SUBJECTS,
    *commands.SUBJECTS,
    *runs.SUBJECTS,
    *library.SUBJECTS,
    *aligning.SUBJECTS,
    *live.SUBJECTS,
    *agreement.SUBJECTS,
    *bookkeeping.SUBJECTS,
)
