"""The range of a setting, found by asking its check: so it is never another than the one that is checked."""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from slam.bounds import LEAST

Accepts = Callable[[float], bool]

_TRIED = 130  # whole numbers from zero on that are tried one by one, to find sets such as 16 and 64
_LARGE, _SMALL = 1e15, 1e-12  # taken for infinity and for zero
_STEPS = 60  # bisections: enough for nine digits between the two


def range_of_integers(accepts: Accepts, default: int | None) -> str:
    """Which whole numbers are accepted: ``"16, 64"``, or an interval such as ``"[3, ∞)"``."""
    tried = [n for n in range(_TRIED) if accepts(n)]
    if tried and tried[-1] < _TRIED - 1 and tried != list(range(tried[0], tried[-1] + 1)):
        return ", ".join(map(str, tried))
    inside = default if default is not None else tried[0] if tried else None
    if inside is None:
        return "whole numbers"
    low = _last_integer(accepts, inside, -int(_LARGE))
    high = _last_integer(accepts, inside, int(_LARGE))
    return _interval(float(low), float(high), accepts)


def range_of_numbers(accepts: Accepts, default: float | None) -> str:
    """Which numbers are accepted, as an interval such as ``"(0, 1]"``."""
    if default is None:
        return "numbers"
    inside = min(max(default, -_LARGE), _LARGE)
    return _interval(_last_number(accepts, inside, -1.0), _last_number(accepts, inside, 1.0), accepts)


def _last_integer(accepts: Accepts, inside: int, outside: int) -> float:
    """The last accepted whole number on the way from one inside to one outside; infinite where all are accepted."""
    if accepts(outside):
        return inf if outside > inside else -inf
    while abs(outside - inside) > 1:
        middle = (inside + outside) // 2
        inside, outside = (middle, outside) if accepts(middle) else (inside, middle)
    return inside


def _last_number(accepts: Accepts, inside: float, sign: float) -> float:
    """The end of the accepted numbers above (sign 1) or below (sign -1) one inside: infinite, zero, or a number."""
    if accepts(sign * _LARGE):
        return sign * inf
    if inside * sign < 0 and not accepts(sign * _SMALL):
        return 0.0 if accepts(0.0) or accepts(-sign * _SMALL) else _bisected(accepts, inside, -sign * _SMALL)
    if inside == 0 and not accepts(sign * _SMALL):  # zero itself is allowed, and numbers from `LEAST` on
        return _bisected(accepts, sign * LEAST, sign * _LARGE) if accepts(sign * LEAST) else 0.0
    return _bisected(accepts, inside if inside * sign > 0 else sign * _SMALL, sign * _LARGE)


def _bisected(accepts: Accepts, inside: float, outside: float) -> float:
    """The end of what is accepted between two numbers of one sign, by bisection of their logarithms."""
    for _ in range(_STEPS):
        middle = (1 if inside > 0 else -1) * (inside * outside) ** 0.5
        inside, outside = (middle, outside) if accepts(middle) else (inside, middle)
    return float(f"{inside:.9g}")


def _interval(low: float, high: float, accepts: Accepts) -> str:
    """An interval in the usual brackets; an end that is infinite is written open."""
    first = "(-∞" if low == -inf else f"{'[' if accepts(_whole(low)) else '('}{low:.10g}"
    last = "∞)" if high == inf else f"{high:.10g}{']' if accepts(_whole(high)) else ')'}"
    return f"{first}, {last}"


def _whole(number: float) -> float:
    """A whole number as an integer, which is accepted wherever it may be."""
    return int(number) if float(number).is_integer() else number
