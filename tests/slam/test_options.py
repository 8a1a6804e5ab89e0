from dataclasses import dataclass

import pytest

from slam.errors import ConfigurationError
from slam.options import from_options


@dataclass(frozen=True)
class Settings:
    a: int = 1
    b: str = "x"


def test_given_options_replace_defaults():
    assert from_options(Settings, "thing", {"b": "y"}) == Settings(1, "y")


def test_an_unknown_option_is_refused_with_the_known_ones():
    with pytest.raises(ConfigurationError, match="thing: unknown option 'c'; known: a, b"):
        from_options(Settings, "thing", {"a": 2, "c": 3})
