"""The contract of a back end as checks that any back end can be put through, third-party ones included.

With pytest, one test a check::

    import pytest
    from slam.testing import BACKEND_CHECKS

    @pytest.mark.parametrize("check", BACKEND_CHECKS, ids=lambda check: check.__name__)
    def test_contract(check):
        check(MyBackend)

or all at once: ``check_backend(MyBackend)``. The factory is called as ``factory(rig, models=EstimatorModels(...))``.
Nothing here needs pytest. Tolerances are some ten times what a good estimator reaches on the scene: they find what is
broken, not what is mediocre. May import everything but `slam.run`, `slam.compare` and `slam.commands`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from slam.errors import SlamError
from slam.testing import estimation, protocol
from slam.testing.scene import GENERAL_RIG, MODELS, RIG, SIGMA, Factory

__all__ = ["BACKEND_CHECKS", "GENERAL_RIG", "MODELS", "RIG", "SIGMA", "Factory", "check_backend"]

#: Every check of the contract, in the order of increasing demands.
BACKEND_CHECKS: Sequence[Callable[[Factory], None]] = (
    protocol.first_prediction_is_the_start,
    protocol.initial_pose_is_kept,
    protocol.time_must_increase,
    protocol.calls_before_the_first_prediction,
    protocol.unknown_option_is_refused,
    protocol.nothing_seen_is_no_error,
    protocol.ids_must_fit_the_map,
    estimation.new_landmarks_are_triangulated,
    protocol.estimate_is_in_order,
    protocol.trajectory_has_every_stamp,
    protocol.results_are_the_callers_own,
    protocol.same_input_same_bytes,
    estimation.follows_the_camera,
    estimation.follows_with_a_general_rig,
    estimation.velocity_is_learnt,
    estimation.predictions_are_of_landmarks_in_view,
    estimation.innovations_are_as_predicted,
    estimation.left_pixels_alone_are_measured,
    estimation.wrong_match_is_rejected,
    estimation.guess_is_no_measurement,
    protocol.removed_landmarks_are_gone,
)


def check_backend(factory: Factory) -> None:
    """Put a back end through the whole contract.

    Args:
        factory: called as ``factory(rig, models=...)``, for each check anew; usually the back end's class.

    Raises:
        AssertionError: the first check that fails, by name.
    """
    for check in BACKEND_CHECKS:
        try:
            check(factory)
        except (AssertionError, SlamError) as error:
            raise AssertionError(f"{check.__name__}: {error}") from error
