"""All classes of inputs."""

from __future__ import annotations

from tests.fuzz import readers

SUBJECTS = (*readers.SUBJECTS,)
