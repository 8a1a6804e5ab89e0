"""All classes of inputs."""

from __future__ import annotations

from tests.fuzz import commands, library, readers, runs, saved, settings

SUBJECTS = (
    *readers.SUBJECTS,
    *settings.SUBJECTS,
    *saved.SUBJECTS,
    *commands.SUBJECTS,
    *runs.SUBJECTS,
    *library.SUBJECTS,
)
