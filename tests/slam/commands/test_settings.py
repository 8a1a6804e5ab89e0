from __future__ import annotations

from dataclasses import fields

import pytest

import slam
from slam import registry
from slam.commands.settings import listing
from slam.config import SystemConfig
from slam.errors import ConfigurationError, SlamError
from slam.run.settings_reference import settings
from slam.settings import leaves

RIG = slam.StereoRig.rectified_pair(300, 160, 120, 0.12, 320, 240)


@pytest.fixture(scope="module")
def every():
    return list(settings())


@pytest.fixture
def read(every, monkeypatch):
    """The settings are read once for all tests of their listing."""
    monkeypatch.setattr("slam.commands.settings.settings", lambda: every)


def test_every_setting_is_there_with_its_defaults(every):
    shown = {s.key: s for s in every if not s.owner}
    for kind in ("handheld", "driving"):
        tree = SystemConfig.for_kind(kind).to_json()
        keys = [key for key in leaves(tree) if key.partition(".")[0] not in ("frontend", "backend")]
        assert set(keys) == set(shown)
        for key in keys:
            value = tree
            for part in key.split("."):
                value = value[part]
            assert shown[key].defaults[kind] == value, key


@pytest.mark.parametrize("role", ["frontend", "backend"])
def test_every_option_of_front_ends_and_back_ends_is_there(every, role):
    for name in registry.names(f"{role}s"):
        part = registry.create(f"{role}s", name, RIG)
        wanted = {f"{role}.{f.name}" for f in fields(part.config)}
        assert {s.key for s in every if s.owner == name and s.key.startswith(role)} == wanted


def test_an_unknown_section(read):
    with pytest.raises(SlamError, match="did you mean 'map'"):
        listing("mapp", 80)
    with pytest.raises(SlamError, match=r"there is map\.grid"):
        listing("grid", 80)


def test_values_at_the_ends_of_ranges_are_accepted_and_beyond_refused():
    default = SystemConfig()
    for setting in ("association.ratio=1", "map.target_in_view=3", "map.target_in_view=1000"):
        default.with_settings([setting])
    for setting in ("association.ratio=0", "association.ratio=1.001", "map.target_in_view=1001"):
        with pytest.raises(ConfigurationError):
            default.with_settings([setting])
