from functools import reduce
from operator import getitem

import pytest

import slam
from slam import registry
from slam.config import SystemConfig
from slam.errors import ConfigurationError
from slam.run.settings_reference import listing, settings
from slam.settings import SETTABLE, can_be_set, leaves, require_settable

RIG = slam.StereoRig.rectified_pair(300, 160, 120, 0.12, 320, 240)


@pytest.fixture(scope="module")
def every():
    return list(settings())


def test_what_can_be_set_is_there_with_its_defaults(every):
    shown = {s.key: s for s in every if not s.owner}
    for kind in ("handheld", "driving"):
        tree = SystemConfig.for_kind(kind).to_json()
        keys = [key for key, _ in leaves(tree) if key.partition(".")[0] not in ("frontend", "backend")]
        assert {key for key in keys if can_be_set(key)} == set(shown)
        for key in shown:
            value = reduce(getitem, key.split("."), tree)
            assert shown[key].defaults[kind] == value, key
    assert len(every) <= 40
    assert [s.key for s in every if not s.text] == []  # each has a meaning
    named = {(s.owner or s.key.partition(".")[0], s.key.partition(".")[2]) for s in every}
    assert {(owner, name) for owner, names in SETTABLE.items() for name in names} <= named


def test_a_setting_of_the_program_itself_is_refused():
    tree = SystemConfig().to_json()
    for text in ("map.grid=[4, 4]", "frontend.octaves=3"):
        with pytest.raises(ConfigurationError, match=r"setting (map\.grid|frontend\.octaves): cannot be set"):
            require_settable([text], tree, "surf")
    require_settable(["map.max_landmarks=300", "backend.lag=8", "frontend.octaves=3", "map.colour=1"], tree, "other")


OWN = """
from dataclasses import dataclass
from backends.ekf import EkfBackend
from slam.guarded import guarded
class Near(EkfBackend):
    def __init__(self, rig, models=None, least=2.0, **options):
        super().__init__(rig, **options)
class Plain:
    def __init__(self, rig, models=None): pass
@guarded
class Behind:
    def __init__(self, rig, models, wobble=3.0): pass
    predict = update = remove = estimate = print
"""


def test_options_of_a_class_of_one_s_own_are_listed_and_named_in_errors(tmp_path, monkeypatch):
    """They were in neither, nor was a wrong one refused that was given with an object."""
    (tmp_path / "own_options.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    shown = "\n".join(listing("own_options:Near", 80))
    assert "backend.least = 2.0" in shown and "backend.iterations = 20\n      most linearisations" in shown
    with pytest.raises(ConfigurationError, match=r"'leest' \(did you mean 'least'\?\); known: least, "):
        registry.create("backends", "own_options:Near", RIG, leest=3.0)
    assert "own_options:Plain has no options" in next(listing("own_options:Plain", 80))
    assert "backend.wobble = 3.0" in "\n".join(listing("own_options:Behind", 80))
    with pytest.raises(ConfigurationError, match="is none: it lacks add"):
        registry.create("backends", "own_options:Behind", RIG)
    config = SystemConfig().with_settings({"backend.leest": 3.0})
    with pytest.raises(ConfigurationError, match=r"backend\.leest: an object is made with its options"):
        slam.StereoSlam(RIG, backend=registry.create("backends", "ekf", RIG.rectified.rig), config=config)
