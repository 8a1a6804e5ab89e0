from __future__ import annotations

import json
from dataclasses import dataclass, fields

import pytest

import slam
from slam import registry
from slam.commands.settings import listing
from slam.config import SystemConfig
from slam.errors import ConfigurationError, SlamError
from slam.run.ranges import range_of_integers, range_of_numbers
from slam.run.settings_reference import documented, settings
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


def test_defaults_differ_by_kind_of_motion_where_they_do(every):
    shown = {(s.owner, s.key): s.defaults for s in every}
    assert shown["", "map.max_landmarks"] == {"handheld": 1000, "driving": 200}
    assert shown["ekf", "backend.landmarks"] == {"handheld": "inverse_depth", "driving": "inverse_depth"}
    assert shown["surf", "frontend.upright"] == {"handheld": False, "driving": True}


def test_every_setting_says_what_it_means(every):
    for s in every:
        assert len(s.text) > 8, s.key
        assert not s.text.endswith((" and", " or", ",", ";")), s.key
        assert s.range, s.key
        if "[px]" in s.text or "[m]" in s.text:
            assert s.unit, s.key


def test_units_go_to_their_settings_in_order(every):
    units = {s.key: s.unit for s in every if not s.owner}
    assert units["models.initial_position_sigma"] == "m"
    assert units["models.initial_rotation_sigma"] == "rad"
    assert units["objects.search_radius"] == units["objects.search_limit"] == "px"
    assert units["association.view_angle"] == "degrees"
    assert units["association.view_ratio"] == units["map.grid"] == ""


def test_ranges_are_those_that_are_checked(every):
    ranges = {(s.owner, s.key): s.range for s in every}
    assert ranges["surf", "frontend.descriptor"] == "16, 64"
    assert ranges["surf", "frontend.octaves"] == "[1, 4]"
    assert ranges["", "association.ratio"] == "[1e-09, 1]"
    assert ranges["surf", "frontend.min_correlation"] == "[0, 1]"
    assert ranges["", "objects.mode"] == "detect, procedure1, off"
    assert ranges["", "objects.database"] == "text"
    assert ranges["", "map.monocular"] == "true or false"
    assert ranges["smoother", "backend.lag"].startswith("[2, ")
    assert ranges["smoother", "backend.lag"].endswith(" or null")


@pytest.mark.parametrize(
    ("accepts", "default", "range_"),
    [
        (lambda x: x >= 0, 0.0, "[0, ∞)"),
        (lambda x: x > 0, 5.0, "(0, ∞)"),
        (lambda x: 0 < x <= 1, 0.5, "(0, 1]"),
        (lambda x: -3 <= x < 7.25, 1.0, "[-3, 7.25)"),
        (lambda x: -3 <= x < 7.25, -1.0, "[-3, 7.25)"),
        (lambda x: 2 < x < 3, 2.5, "(2, 3)"),
        (lambda x: -3 < x < -2, -2.5, "(-3, -2)"),
        (lambda x: x <= 0, 0.0, "(-∞, 0]"),
        (lambda x: True, 0.0, "(-∞, ∞)"),
        (lambda x: 1e-9 <= x <= 1e9, 1.0, "[1e-09, 1000000000]"),
        (lambda x: x == 0 or 1e-9 <= x <= 5, 1.0, "[0, 5]"),
        (lambda x: x == 0 or 1e-9 <= x <= 5, 0.0, "[0, 5]"),
    ],
)
def test_ranges_of_numbers(accepts, default, range_):
    assert range_of_numbers(accepts, default) == range_


@pytest.mark.parametrize(
    ("accepts", "default", "range_"),
    [
        (lambda n: n >= 3, 8, "[3, ∞)"),
        (lambda n: n in (16, 64), 64, "16, 64"),
        (lambda n: 0 <= n <= 10**6, 0, "[0, 1000000]"),
        (lambda n: n >= 12, None, "[12, ∞)"),
        (lambda n: False, None, "whole numbers"),
    ],
)
def test_ranges_of_whole_numbers(accepts, default, range_):
    assert range_of_integers(accepts, default) == range_


@dataclass
class Base:
    """A class.

    Attributes:
        a: length [m],
            over two lines.
    """

    a: int = 1


@dataclass
class Derived(Base):
    """Another.

    Attributes:
        b, c: two of them [px], [s].

    Raises:
        ValueError: never.
    """

    b: int = 1
    c: int = 1


def test_docstrings_of_bases_count():
    assert documented(Derived) == {
        "a": ("m", "length [m], over two lines"),
        "b": ("px", "two of them [px], [s]"),
        "c": ("s", "two of them [px], [s]"),
    }


@pytest.mark.parametrize("width", [80, 100])
def test_the_listing_fits(read, width):
    assert max(map(len, listing(None, width).splitlines())) <= width


@pytest.mark.parametrize("wanted", ["map", "map.grid", "models.motion", "ekf", "backend", "surf"])
def test_a_part_of_the_listing(read, wanted):
    shown = listing(wanted, 80)
    assert ("map.grid" in shown) == wanted.startswith("map")
    assert ("backend.iterations" in shown) == (wanted in ("ekf", "backend"))


def test_defaults_are_shown_as_they_are_typed(read, every):
    lines = listing(None, 100).splitlines()
    for s in every:
        line = next(line for line in lines if line.startswith(f"  {s.key} = "))
        value = line.partition(" = ")[2]
        if isinstance(s.defaults["handheld"], (bool, float, tuple)):
            assert value.startswith(json.dumps(s.defaults["handheld"])), line


def test_an_unknown_section(read):
    with pytest.raises(SlamError, match="did you mean 'map'"):
        listing("mapp", 80)
    with pytest.raises(SlamError, match=r"there is map\.grid, frontend\.grid"):
        listing("grid", 80)


def test_values_at_the_ends_of_ranges_are_accepted_and_beyond_refused():
    default = SystemConfig()
    for setting in ("association.ratio=1", "map.target_in_view=3", "map.target_in_view=1000"):
        default.with_settings([setting])
    for setting in ("association.ratio=0", "association.ratio=1.001", "map.target_in_view=1001"):
        with pytest.raises(ConfigurationError):
            default.with_settings([setting])
