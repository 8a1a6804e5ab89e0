"""The time in which kernels are compiled is counted once, however compilations nest, and is in no other time."""

import subprocess
import sys

import pytest

WARM_UP = """
import sys
from slam.run.warm_up import warm_up
warm_up()
assert warm_up() == 0.0
rooms = ("slam.", "frontends.", "backends.")
values = [v for name, module in list(sys.modules.items()) if name.startswith(rooms) for v in vars(module).values()]
kernels = {v for v in values if getattr(getattr(v, "stats", None), "cache_path", None)}
assert len(kernels) > 50
print(*(f"{k.py_func.__module__}.{k.__name__}" for k in kernels if len(k.signatures) != 1))
"""


@pytest.mark.slow
def test_after_warming_up_nothing_is_left_to_compile_or_to_load_and_each_kernel_is_compiled_once():
    done = subprocess.run([sys.executable, "-c", WARM_UP], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stdout.split(), "never called, or compiled for several types or layouts of arrays"
