"""All settings of a run in one frozen, validated tree; read from and written to plain JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from slam.atlas.config import AtlasConfig
from slam.bodies.config import ObjectsConfig
from slam.bounds import require_not_negative
from slam.calibration.config import SelfCalibrationConfig
from slam.errors import ConfigurationError
from slam.models import EstimatorModels, models_for
from slam.settings import with_changes
from slam.tracks.config import AssociationConfig, MapConfig

#: What is set by kind of motion. A car does not soon return to what it has passed, and gets so much nearer to what lies
#: ahead that descriptors change. They are updated on approach, so the angle and distance of view are not limited.
#: Neither more landmarks (`experiments/knee.py`) nor features aligned to their first sight (`experiments/ablation.py`)
#: make recorded drives better. Traffic is faster than what a hand or a robot moves.
_BY_KIND: dict[str, dict[str, Any]] = {
    "handheld": {},
    "driving": {
        "map": MapConfig(target_in_view=100, max_landmarks=133, descriptor_update=1.0, confirmed=1, spacing=0.0),
        "association": AssociationConfig(view_angle=180.0, view_ratio=1e6, align=False),
        "objects": ObjectsConfig(max_speed=25.0, min_speed=1.0, suspect=40.0, size=2.0),
    },
}

#: Options of a front end that suit a kind of motion: a car does not roll, a hand-held camera does; nothing comes
#: within a metre of the cameras of a car. More features make drives no better (`experiments/knee.py`).
_FRONTENDS: dict[tuple[str, str | None], dict[str, Any]] = {
    ("handheld", "surf"): {"upright": False},
    ("driving", "surf"): {"features": 600, "upright": True, "min_depth": 1.0},
}


@dataclass(frozen=True)
class SystemConfig:
    """Everything that can be set.

    Attributes:
        models: noise, priors and motion model of all back ends.
        association: search windows, descriptor distances, geometric check.
        map: which features become landmarks and which landmarks are erased.
        atlas: keyframes and loop closure.
        self_calibration: estimation of the rig's error while running.
        objects: the detector of moving objects.
        frontend: options of the front end by name.
        backend: options of the back end by name.

    Raises:
        ConfigurationError: a part is of the wrong type.
    """

    models: EstimatorModels = field(default_factory=EstimatorModels)
    association: AssociationConfig = field(default_factory=AssociationConfig)
    map: MapConfig = field(default_factory=MapConfig)
    atlas: AtlasConfig = field(default_factory=AtlasConfig)
    self_calibration: SelfCalibrationConfig = field(default_factory=SelfCalibrationConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    frontend: dict[str, Any] = field(default_factory=dict)
    backend: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_not_negative(self)
        for section in ("frontend", "backend"):
            taken = [key for key in getattr(self, section) if key in _GIVEN]
            if taken:
                raise ConfigurationError(f"{section}.{taken[0]}: the system gives this, so it is no option")

    @classmethod
    def for_kind(cls, kind: str, frontend: str | None = "surf") -> SystemConfig:
        """The default settings for a kind of motion (``"handheld"``, ``"driving"``), and a front end by name.

        Raises:
            ConfigurationError: the kind is not known.
        """
        models, options = models_for(kind), dict(_FRONTENDS.get((kind, frontend), {}))
        return cls(models=models, frontend=options, **_BY_KIND[kind])

    def to_json(self) -> dict[str, Any]:
        """The tree as plain types."""
        return asdict(self)

    @classmethod
    def from_json(cls, tree: Mapping[str, Any]) -> SystemConfig:
        """The configuration of a tree as `to_json` gives it, such as the settings in a run's ``config.json``.

        Raises:
            ConfigurationError: a key is unknown, or a value is of the wrong type or out of range.
        """
        return cls().with_settings(tree)

    def with_settings(self, settings: Sequence[str] | Mapping[str, Any]) -> SystemConfig:
        """A copy with settings applied: ``{"map.max_landmarks": 300}``, or ``["map.max_landmarks=300"]``.

        Values in texts are JSON (``true``, ``3.5``, ``[1, 2]``) or plain words. Names of options of front end and back
        end are checked where these are made.

        Raises:
            ConfigurationError: not of that form, an unknown key, a value of the wrong type or out of range.
        """
        changed: SystemConfig = with_changes(self, settings)
        return changed


#: What the system itself gives to front ends and back ends that it makes.
_GIVEN = ("self", "rig", "models")
