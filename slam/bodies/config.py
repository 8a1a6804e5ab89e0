"""Settings of the detector of moving objects, and the numbers that its parts share."""

from __future__ import annotations

from dataclasses import dataclass

from slam.bounds import require_not_negative
from slam.errors import ConfigurationError
from slam.geometry.rig import MINIMAL_POINTS

MODES = ("detect", "procedure1", "off")
WINDOW = 12  #: cost: frames over which a feature is classified: every track keeps so many measurements
MIN_POINTS = MINIMAL_POINTS + 1  #: points of a new body, as three have some pose in any case
MIN_FRAMES = 4  #: measurements from which on a feature is classified
CLEAR = 6.0  #: χ² by which a track says for certain with which of two motions it goes: 20 to 1
EXPLAINED = 0.2  #: share of the χ² of "still" that a motion, itself uncertain, may leave of what moves with it
RUN = 3  #: frames in a row that are no chance: of a common motion, without a match, of a point that disagrees


@dataclass(frozen=True)
class ObjectsConfig:
    """Settings of the detector of moving objects.

    Attributes:
        mode: ``"detect"`` finds moving bodies without being told; ``"procedure1"`` is the papers' detector with a
            database of known features (paper B, 3); ``"off"``.
        max_speed: largest speed of a point of a body [m/s]; bounds the search for moving features.
        min_speed: slower bodies are not detected [m/s].
        suspect: χ²(6) of a large group's motion relative to the rest of the scene above which its landmarks are not
            used to measure the camera's pose; the group moves from half as much more on. Both are higher for small
            groups.
        size: what bodies measure across at least, seen in part or whole [m].
        database: file of the object's features for ``"procedure1"``, see `slam.papers.procedure1`.
    """

    mode: str = "detect"
    max_speed: float = 1.5
    min_speed: float = 0.01
    suspect: float = 20.0
    size: float = 0.0
    database: str = ""

    def __post_init__(self) -> None:
        require_not_negative(self, {}, "objects")
        if self.mode not in MODES:
            raise ConfigurationError(f"objects: mode must be one of {', '.join(MODES)}, got {self.mode!r}")
        if self.mode == "procedure1" and not self.database:
            raise ConfigurationError("objects: mode procedure1 needs a database of the object's features")
        for name in ("max_speed", "suspect"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"objects: {name} must be positive, got {getattr(self, name)}")

    @property
    def moves(self) -> float:
        """χ²(6) above which a large group moves."""
        return 1.5 * self.suspect
