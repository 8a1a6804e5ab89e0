"""All classes of inputs."""

from __future__ import annotations

from tests.fuzz import readers, settings

SUBJECTS = (*readers.SUBJECTS, *settings.SUBJECTS)
