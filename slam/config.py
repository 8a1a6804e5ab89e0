"""All settings of a run in one frozen, validated tree; read from and written to plain JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any, get_args, get_type_hints

from slam.atlas.config import AtlasConfig
from slam.bodies.config import ObjectsConfig
from slam.bounds import MOST, require_not_negative
from slam.calibration.config import SelfCalibrationConfig
from slam.errors import ConfigurationError
from slam.models import EstimatorModels, models_for
from slam.settings import apply_settings
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
    def from_json(cls, tree: dict[str, Any]) -> SystemConfig:
        """The configuration of a tree of plain types, as `to_json` writes it; what is left out has its default.

        Raises:
            ConfigurationError: a key is unknown, or a value is of the wrong type or out of range.
        """
        built: SystemConfig = _built(cls, tree)
        return built

    def with_settings(self, settings: Sequence[str] | Mapping[str, Any]) -> SystemConfig:
        """A copy with settings applied: ``{"map.max_landmarks": 300}``, or ``["map.max_landmarks=300"]``.

        Values in texts are JSON (``true``, ``3.5``, ``[1, 2]``) or plain words. Names of options of front end and back
        end are checked where these are made.

        Raises:
            ConfigurationError: not of that form, an unknown key, a value of the wrong type or out of range.
        """
        tree = self.to_json()
        apply_settings(tree, settings)
        return self.from_json(tree)


#: What the system itself gives to front ends and back ends that it makes.
_GIVEN = ("self", "rig", "models")


def _built(kind: Any, tree: Mapping[str, Any], where: str = "") -> Any:
    """A dataclass of settings, and those in it, from a tree of plain types; `where` is its place in the whole."""
    if not isinstance(tree, Mapping):
        what = f"setting {where[:-1]}" if where else "settings"
        raise ConfigurationError(f"{what} must be an object, got {tree!r:.80}")
    hints, names, values = get_type_hints(kind), {f.name for f in fields(kind)}, {}
    for key, value in tree.items():
        if key not in names:
            raise ConfigurationError(f"setting {where}{key}: there is no such setting in this version")
        if is_dataclass(hints[key]):
            value = _built(hints[key], value, f"{where}{key}.")
        values[key] = _as_hinted(value, hints[key])
    try:
        return kind(**values)
    except ConfigurationError as error:
        said = str(error).removeprefix(f"{where[:-1].rpartition('.')[2]}: ")  # the section names itself
        raise ConfigurationError(f"setting {where}{said}") from None


def _as_hinted(value: Any, hint: Any) -> Any:
    """A value of a text as the field has it: ``3`` is 3.0 where numbers need not be whole, a list is a tuple."""
    if isinstance(value, list):
        inner = next(iter(get_args(hint)), None)
        return tuple(_as_hinted(one, inner) for one in value)
    if hint is float and type(value) is int and abs(value) <= MOST:
        return float(value)
    return value
