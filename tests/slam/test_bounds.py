"""Settings have types and ranges with an upper end, in the library and from the command line."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.errors import ConfigurationError, SlamError, one_line
from tests.fuzz.settings import CLASSES

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
                assert ("\n" not in str(error) and len(str(error)) < 700 and f.name in str(error)) or "objects:" in str(
                    error
                )
        assert refused >= 8, f"{kind.__name__}.{f.name} takes nearly anything"


def test_a_setting_of_any_length_is_refused_in_one_line():
    for text in ("map.grid=" + "[" * 100_000, "x" * 100_000, "models.pixel_sigma=" + "9" * 5000):
        with pytest.raises(ConfigurationError) as caught:
            SystemConfig().with_settings([text])
        assert len(str(caught.value)) < 700


def test_numpys_numbers_and_lists_are_taken():
    from slam.mapping.selection import MapConfig

    assert MapConfig(grid=[8, 4], max_landmarks=np.int64(500), spacing=np.float32(0.5), separation=3)


def test_one_line():
    assert one_line("a\nb\x1b[1mc\0") == r"a b\x1b[1mc\x00"
    assert len(one_line("x" * 10_000)) < 700 and "…" in one_line("x" * 10_000)
    assert str(SlamError("a\r\nb")) == r"a\r b"
