"""Settings: from text and files to their place, with types and ranges."""

import json
import re
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest

from backends.ekf import EkfConfig
from backends.smoother.config import SmootherConfig
from experiments import ablation_parts
from frontends.surf.config import SurfConfig
from slam.bodies.config import ObjectsConfig
from slam.calibration.config import SelfCalibrationConfig
from slam.config import SystemConfig
from slam.errors import ConfigurationError
from slam.models import EstimatorModels, MotionModel, ObjectModels
from slam.tracks.config import AssociationConfig, MapConfig


def test_settings_reach_their_place():
    config = SystemConfig.for_kind("driving").with_settings(
        [
            "map.max_landmarks=301",
            "backend.measurement=left",
            "frontend.threads=1",
            "association.d_match=[0.3, 0.2]",
            "models.motion.acceleration=2",
        ]
    )
    assert config.map.max_landmarks == 301
    assert config.backend == {"measurement": "left"}
    assert config.frontend == SystemConfig.for_kind("driving").frontend | {"threads": 1}
    assert config.association.d_match == (0.3, 0.2)
    assert config.models.motion.acceleration == 2.0
    assert SystemConfig.for_kind("driving").map.max_landmarks != 301


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("maps.max_landmarks=3", "unknown section 'maps' (did you mean 'map.max_landmarks'?); known: models"),
        ("map.max_landmarks", "not of the form"),
        ("models.pixel_sigma=abc", "models.pixel_sigma must be a number, got 'abc'"),
        ("association.align=often", "association.align must be true or false, got 'often'"),
        ("objects.min_speed=-1.0", "objects.min_speed must be finite, from 0 to 1e+09, got -1.0"),
        (
            "objects.min_speed=1e-12",
            "objects.min_speed must be finite",
        ),  # its square, and the inverse of that, are none
        ("map.max_landmarks=true", "map.max_landmarks must be a whole number, got True"),
        ("models.T_world_left=[1]", "models.T_world_left must be a (4, 4) pose"),
        ("backend.rig=3", "backend.rig: the system gives this"),
        ("map=3", "is a section"),
        ("association.window_sigmas=[5.0, 2.5]", "must be ascending, one for each value of d_match"),
        ("map.max_landmarks=3", "target_in_view must not lie above max_landmarks"),
        ("map.max_speed=3", "did you mean 'objects.max_speed'?"),  # not that of the models, which cannot be set
    ],
)
def test_bad_settings(setting, message):
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        SystemConfig.for_kind("handheld").with_settings([setting])


def test_unknown_kind_and_unknown_key_in_a_file():
    with pytest.raises(ConfigurationError, match="known: handheld, driving"):
        SystemConfig.for_kind("flying")
    tree = SystemConfig().to_json()
    tree["map"]["colour"] = 1
    with pytest.raises(ConfigurationError, match=r"map\.colour"):
        SystemConfig.from_json(tree)
    with pytest.raises(ConfigurationError, match=r".motion. is a section"):
        SystemConfig.from_json({"models": {"motion": None}})


def test_a_configuration_comes_back_from_its_json_with_options_of_any_shape():
    own = {
        "backend.opt": {"a": {"b": 1}},
        "backend.none": {},
        "map.grid": [4, 3],
        "models.T_world_left": np.eye(4).tolist(),
    }
    for config in (SystemConfig(), SystemConfig.for_kind("driving").with_settings(own)):
        assert SystemConfig.from_json(json.loads(json.dumps(config.to_json()))) == config
    assert config.backend == {"opt": {"a": {"b": 1}}, "none": {}}
    for tree in ({"a": {}}, {"map": {"max_landmarks": {}}}):
        with pytest.raises(ConfigurationError, match=r"'a'|max_landmarks must be a whole number"):
            SystemConfig.from_json(tree)


def test_a_whole_number_in_place_of_a_fraction_is_the_same_setting():
    whole, fraction = (
        SystemConfig().with_settings([f"map.separation={two}", f"association.window_sigmas=[{two}, 4.0]"])
        for two in ("2", "2.0")
    )
    assert json.dumps(whole.to_json()) == json.dumps(fraction.to_json())
    assert SystemConfig().with_settings(["map.spacing=2000000"]).map.spacing == 2e6  # a length is no count


CLASSES = (
    SurfConfig, EkfConfig, SmootherConfig, MapConfig, AssociationConfig, SelfCalibrationConfig, ObjectsConfig,
    EstimatorModels, MotionModel, ObjectModels, SystemConfig,
)  # fmt: skip

HOSTILE = (None, "x", b"x", [], {}, 1j, 10**23, 10**400, 1e308, -1e308, np.nan, np.inf, -1, (1, 2, 3, 4), object())


@pytest.mark.parametrize("kind", CLASSES, ids=lambda k: k.__name__)
def test_every_field_of_every_class_refuses_what_it_cannot_be(kind):
    for f in fields(kind):
        refused = 0
        for value in HOSTILE:
            try:
                kind(**{f.name: value})
            except ConfigurationError as error:
                refused += 1
                assert "\n" not in str(error) and len(str(error)) < 700 and f.name in str(error)
        assert refused >= 8, f"{kind.__name__}.{f.name} takes nearly anything"


@pytest.mark.parametrize("kind", ["driving", "handheld"])
def test_the_settings_of_the_ablation_can_be_set(kind):
    """Its quick form has hand-held worlds alone: on drives more landmarks were asked for than the map may have."""
    for variant in (variant for group in ablation_parts.GROUPS for variant in group):
        for backend in ("ekf", "smoother"):
            variant.config(SimpleNamespace(kind=kind), ablation_parts.CASES[0], backend)
