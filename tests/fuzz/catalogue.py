"""All classes of inputs."""

from __future__ import annotations

from tests.fuzz import (
    agreement,
    aligning,
    bookkeeping,
    commands,
    finished,
    foreign,
    library,
    live,
    lives,
    lying_atlases,
    readers,
    runs,
    saved,
    settings,
    values,
)

SUBJECTS = (
    *readers.SUBJECTS,
    *settings.SUBJECTS,
    *saved.SUBJECTS,
    *lying_atlases.SUBJECTS,
    *commands.SUBJECTS,
    *finished.SUBJECTS,
    *runs.SUBJECTS,
    *values.SUBJECTS,
    *library.SUBJECTS,
    *lives.SUBJECTS,
    *foreign.SUBJECTS,
    *aligning.SUBJECTS,
    *live.SUBJECTS,
    *agreement.SUBJECTS,
    *bookkeeping.SUBJECTS,
)
