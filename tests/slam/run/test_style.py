from __future__ import annotations

import itertools

from matplotlib.colors import is_color_like

from slam import registry
from slam.run.schema import STAGES
from slam.run.style import backend_colours, stage_colour, stage_name, stages


def test_a_back_end_has_one_colour_in_whatever_company():
    names = ["ekf", "smoother", "window", "batch"]
    own = {name: backend_colours([name])[0] for name in names}
    assert len(set(own.values())) == 4
    for order in itertools.permutations(["mine", *names]):
        shown = dict(zip(order, backend_colours(order)))
        assert {name: shown[name] for name in names} == own
        assert shown["mine"] not in own.values()


def test_built_in_back_ends_have_colours_of_their_own():
    """The colour that another one would have is nobody else's."""
    others = backend_colours(["mine"])
    assert all(backend_colours([name]) != others for name in registry.names("backends"))


def test_runs_of_one_back_end_differ():
    shown = backend_colours(["ekf"] * 8)
    assert len(set(shown)) == 8
    assert shown[0] == backend_colours(["ekf"])[0]
    assert backend_colours(["ekf", "ekf", "smoother"])[2] == backend_colours(["smoother"])[0]
    assert all(map(is_color_like, backend_colours(["ekf"] * 30)))


def test_stages_have_an_order_a_name_and_a_colour():
    assert stages(["total", *reversed(STAGES)]) == list(STAGES)
    assert len({stage_colour(stage) for stage in STAGES}) == len({stage_name(stage) for stage in STAGES}) == len(STAGES)
    assert stage_name("atlas") == "places and loops"
