"""The numbers by which a rig is recognised: of files that are of one rig alone."""

from __future__ import annotations

from collections.abc import Mapping

from slam.geometry.rig import StereoRig

NUMBERS = ("width", "height", "focal", "baseline", "u0", "v0", "right_u0")


def rig_numbers(rig: StereoRig) -> dict[str, float]:
    """The rectified cameras as delivered, to which all corrections refer, by the names of `NUMBERS`.

    Size of the images, focal length [px], distance of the cameras [m], principal point of the left camera and that of
    the right one along the rows [px].
    """
    r = rig.rectified.rig
    values = r.width, r.height, r.left.fu, r.baseline, r.left.u0, r.left.v0, r.right.u0
    return dict(zip(NUMBERS, map(float, values)))


def rig_difference(there: Mapping[str, float], here: Mapping[str, float], share: float = 1e-5) -> str:
    """The first number of two rigs that differs, in words; empty if none does.

    Numbers of one calibration, written and read, differ by less than the default `share` of their size. Only those
    that are in `there` are compared.
    """
    for name, value in there.items():
        if abs(value - here[name]) > share * max(abs(value), abs(here[name])):
            return f"{name} {value:g} there, {here[name]:g} here"
    return ""
