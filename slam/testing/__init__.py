"""The contract of a back end as checks that any back end can be put through, third-party ones included.

The contract has three tiers; each takes in the one before it:

- ``"runs"``: it gets through a run. What the system calls is there and returns what the interface says.
- ``"right"``: its answers are those that the interface describes, misuse is refused, and runs repeat.
- ``"good"``: it estimates well: covariances fit the errors, velocity is learnt, wrong matches are rejected.

All at once, from the command line, as a list with a sentence for each failure::

    python -m slam.testing my_package.my_module:MyBackend

With pytest, one test a check::

    import pytest
    from slam.testing import RUNS

    @pytest.mark.parametrize("check", RUNS, ids=lambda check: check.__name__)
    def test_contract(check):
        check(MyBackend)

or in one call: ``check_backend(MyBackend, "runs")``. The factory is called as ``factory(rig, models=…)``.
Nothing here needs pytest. Tolerances are some ten times what a good estimator reaches on the scene: they find what is
broken, not what is mediocre. May import everything but `slam.run`, `slam.compare` and `slam.commands`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from slam.errors import ConfigurationError, text_of
from slam.naming import unknown
from slam.testing import estimation, protocol
from slam.testing.scene import MODELS, RIG, SIGMA, Factory

__all__ = [
    "GOOD", "MODELS", "RIG", "RIGHT", "RUNS", "SIGMA", "TIERS", "Factory", "Finding", "check_backend", "findings",
]  # fmt: skip

Check = Callable[[Factory], None]

#: It gets through a run.
RUNS: Sequence[Check] = (
    protocol.every_method_is_there,
    protocol.answers_are_as_documented,
    protocol.a_run_comes_to_its_end,
)

#: Its answers are those that the interface describes.
RIGHT: Sequence[Check] = (
    protocol.first_prediction_is_the_start,
    protocol.initial_pose_is_kept,
    protocol.misuse_is_refused,
    protocol.a_stamp_has_one_update,
    protocol.nothing_seen_is_no_error,
    estimation.new_landmarks_are_triangulated,
    estimation.predictions_are_of_landmarks_in_view,
    protocol.estimate_is_in_order,
    protocol.trajectory_has_every_stamp,
    protocol.recent_poses_fit_the_estimate,
    protocol.results_are_the_callers_own,
    protocol.removed_landmarks_are_gone,
    protocol.queries_are_pure,
    protocol.rows_that_no_point_explains_are_rejected,
)

#: It estimates well.
GOOD: Sequence[Check] = (
    estimation.follows_the_camera,
    estimation.landmarks_are_corrected,
    estimation.velocity_is_learnt,
    estimation.innovations_are_as_predicted,
    estimation.left_pixels_alone_are_measured,
    estimation.wrong_match_is_rejected,
    estimation.guess_is_no_measurement,
)

#: The tiers by name, in the order of increasing demands.
TIERS: dict[str, Sequence[Check]] = {"runs": RUNS, "right": RIGHT, "good": GOOD}


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    tier: str  # its name
    check: str  # its name
    demand: str  # what it asks for, a sentence
    failure: str  # how the back end fails it, a sentence; empty where it passes


def findings(factory: Factory, tier: str = "good") -> Iterator[Finding]:
    """Put a back end through all checks up to a tier, one after another.

    Args:
        factory: called as ``factory(rig, models=...)``, once for each check; usually the back end's class.
        tier: ``"runs"``, ``"right"`` or ``"good"``.

    Raises:
        ConfigurationError: there is no such tier.
    """
    if tier not in TIERS:
        raise ConfigurationError(unknown("tier", tier, TIERS))
    for name, checks in TIERS.items():
        for check in checks:
            demand = " ".join((check.__doc__ or "").split("\n\n")[0].split())
            yield Finding(name, check.__name__, demand, _failure(check, factory))
        if name == tier:
            return


def check_backend(factory: Factory, tier: str = "good") -> None:
    """Put a back end through the contract, up to a tier; see `findings`.

    Raises:
        AssertionError: the first check that fails, by name, with how it fails and what it asks for.
        ConfigurationError: there is no such tier.
    """
    for finding in findings(factory, tier):
        if finding.failure:
            raise AssertionError(f"{finding.check} ({finding.tier}): {finding.failure}. Asked for: {finding.demand}")


def _failure(check: Check, factory: Factory) -> str:
    """How a check fails, in a sentence; empty where it passes."""
    try:
        check(factory)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - somebody else's: what it raises is a finding
        said = " ".join(text_of(error).split())
        if said and isinstance(error, AssertionError):
            return said
        return f"raised {type(error).__name__}: {said or 'without a message'}"
    return ""
