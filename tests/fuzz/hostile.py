"""Hostile values and mutations of bytes and text that several classes of inputs share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

#: Texts where a number is expected.
NUMBERS = (
    "0", "-1", "nan", "inf", "-inf", "1e308", "-1e308", "1e-308", "1e400", "9" * 23, "9" * 400, "9" * 5000, "1_000",
    str(2**31), str(2**63 - 1), str(2**63), str(2**64), "٣", "0x10", "", "null", "true", "x", "1e", "--1", ".",
    "1:59:59",
)  # fmt: skip

#: Texts where a path or a name is expected.
PATHS = (
    "", ".", "..", "/", "~nobody_of_this_name", "~/nowhere", "/proc", "/proc/self", "/proc/self/fd", "/proc/1/root",
    "/dev", "/dev/null", "/dev/full", "a\0b", "x" * 300, "/".join(["y" * 200] * 30), "new\nline", "\udc80", "?",
    "?fps=", "a?b?c", "?left=a%00b&right=c", "\x1b[31mred", "synthetic:", "synthetic:desk?frames=1e9",
    "synthetic:desk?frames=" + "9" * 5000, "synthetic:desk?frames=3&drop=0:" + "9" * 30,
    "synthetic:desk?frames=3&drop=" + "9" * 30,
    "synthetic:desk?frames=2&drop=nan", "synthetic:\0",
)  # fmt: skip

#: Values of other types than expected, or far out of their range.
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63 - 1, 2**63, 10**23, 10**400, 1e308, -1e308, 1e-308, 5e-324, math.nan,
    math.inf, -math.inf, "", "x", "0", [], [0], [1, 2], [1e308, 1e308], ["x", None], {}, {"a": 1}, b"x", (1, 2, 3),
    1j,
)  # fmt: skip

YAML_BOMBS = (
    "a: &a [1,1,1,1,1,1,1,1]\n"
    + "\n".join(f"a{i}: &a{i} [{','.join([f'*a{i - 1}' if i else '*a'] * 8)}]" for i in range(12))
    + "\nT_BS: *a11\n",
    "a: &a {x: 1}\n"
    + "\n".join(f"b{i}: &b{i} {{<<: [{','.join([f'*b{i - 1}' if i else '*a'] * 9)}]}}" for i in range(9)),
    "x: &x [*x]\n",
    "x: " + "[" * 20_000,
    "x: " + "{a: " * 20_000,
    "x: [" + "1.5, " * 100_000 + "2]\n",
    "x: !!bool maybe\n",
    "x: !!int ''\n",
    "x: !!timestamp x\n",
    "x: !!float z\n",
    "x: !!binary '%'\n",
    "? {a: 1}\n: 2\n",
    "x: !!python/object/apply:os.getcwd []\n",
    "T_BS: !!int ''\n",
    "intrinsics: !!omap [1]\n",
    "%YAML:1.0\n%TAG ! x\n",
    "\t",
    "x: " + "9" * 5000,
    "x: " + ":".join(["59"] * 3000),
    "- 1\n",
    "--- 1\n--- 2\n",
    "resolution: [9" + "9" * 400 + ", 1]\n",
)

XML_BOMBS = (
    '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">' for i in range(9))
    + "]><opencv_storage>&j;</opencv_storage>",
    "<a>" * 50_000,
    '<?xml version="1.0" encoding="x"?><a/>',
    "<opencv_storage><K1><data>1 2</data></K1></opencv_storage>",
    "<opencv_storage><K1><rows>3</rows><data>" + "1 " * 200_000 + "</data></K1></opencv_storage>",
)


def choose(rng: np.random.Generator, options: Any) -> Any:
    """One of a sequence."""
    return options[int(rng.integers(len(options)))]


def broken_bytes(rng: np.random.Generator, data: bytes) -> bytes:
    """Bytes cut, changed, doubled, or replaced."""
    kind = int(rng.integers(7))
    at = int(rng.integers(len(data) + 1))
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + rng.bytes(int(rng.integers(1, 40))) + data[at:]
    if kind == 2:
        return data[:at] + data
    if kind == 3:
        return b""
    if kind == 4:
        return rng.bytes(int(rng.integers(1, 300)))
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 8))):
        if out:
            out[int(rng.integers(len(out)))] = int(rng.integers(256))
    return bytes(out)


def broken_text(rng: np.random.Generator, text: str) -> str:
    """A text table or a calibration with lines or words changed."""
    lines = text.splitlines()
    kind = int(rng.integers(6))
    at = int(rng.integers(len(lines))) if lines else 0
    if not lines or kind == 0:
        return broken_bytes(rng, text.encode()).decode("latin-1")
    if kind == 1:
        del lines[at]
    elif kind == 2:
        lines.insert(at, choose(rng, (lines[-1], choose(rng, NUMBERS), "# x", "\ufeff", "a: b", ",,,", "\0")))
    elif kind == 3:
        lines = [hostile_word(rng, line) for line in lines]
    else:
        lines[at] = hostile_word(rng, lines[at])
    return "\n".join(lines) + "\n"


def hostile_word(rng: np.random.Generator, line: str) -> str:
    """A line with one of its numbers or words replaced."""
    separator = "," if "," in line else " "
    words = line.split(separator)
    words[int(rng.integers(len(words)))] = choose(rng, NUMBERS)
    return separator.join(words)
