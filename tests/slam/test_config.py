from __future__ import annotations

import json
import re

import pytest

from slam.config import SystemConfig
from slam.errors import ConfigurationError


def test_settings_reach_their_place():
    config = SystemConfig.for_kind("driving").with_settings(
        [
            "map.max_landmarks=301",
            "backend.measurement=left",
            "association.d_match=[0.3, 0.2]",
            "models.motion.acceleration=2",
        ]
    )
    assert config.map.max_landmarks == 301
    assert config.backend == {"measurement": "left"}
    assert config.association.d_match == (0.3, 0.2)
    assert config.models.motion.acceleration == 2.0
    assert SystemConfig.for_kind("driving").map.max_landmarks != 301


@pytest.mark.parametrize("kind", ["driving", "handheld"])
def test_json_and_back(kind):
    config = SystemConfig.for_kind(kind).with_settings(["backend.iterations=3"])
    tree = json.loads(json.dumps(config.to_json()))
    assert SystemConfig.from_json(tree) == config


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("map.max=3", "unknown key 'max'; known: target_in_view"),
        ("maps.max_landmarks=3", "unknown section 'maps' (did you mean 'map.max_landmarks'?); known: models"),
        ("max_landmarks=3", "unknown key"),
        ("map.max_landmarks", "not of the form"),
        ("models.pixel_sigma=abc", "models.pixel_sigma: must be a number, got 'abc'"),
        ("map.max_landmarks=many", "map.max_landmarks: must be a whole number, got 'many'"),
        ("association.align=often", "association.align: must be true or false, got 'often'"),
        ("map.grid=3", "map.grid: must be a list, got 3"),
        ("models.T_world_left=[1]", "models.T_world_left.0: must be a list, got 1"),
        ("models.pixel_sigma=-1", "pixel_sigma must be positive"),
        ("models.pixel_sigma=NaN", "pixel_sigma must be positive and finite"),
        ("map.grid=[1]", "map.grid"),
        ("backend.rig=3", "backend.rig: the system gives this"),
        ("frontend.models=1", "frontend.models: the system gives this"),
        ("map=3", "is a section"),
        ("map.separation=NaN", "separation must be finite"),
        ("association.d_match=[NaN, 0.2]", "d_match must be finite"),
        ("association.consistency_sigmas=-3", "consistency_sigmas must be finite and not negative"),
        ("models.T_world_left=[[1, 2], [3, 4]]", "T_world_left must be"),
    ],
)
def test_bad_settings(setting, message):
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        SystemConfig.for_kind("handheld").with_settings([setting])


def test_a_first_pose_comes_through():
    pose = "[[1,0,0,2],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
    config = SystemConfig.for_kind("handheld").with_settings([f"models.T_world_left={pose}"])
    assert config.models.initial_pose[0, 3] == 2
    assert SystemConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


def test_unknown_kind():
    with pytest.raises(ConfigurationError, match="known: handheld, driving"):
        SystemConfig.for_kind("flying")


def test_unknown_key_in_a_file():
    tree = SystemConfig().to_json()
    tree["map"]["colour"] = 1
    with pytest.raises(ConfigurationError, match=r"map\.colour"):
        SystemConfig.from_json(tree)
