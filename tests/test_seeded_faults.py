"""The faults of `tests/seeded_faults.py` can still be put into the code: what each changes stands in its file, once."""

import pytest

from tests.seeded_faults import FAULTS, ROOT


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_has_its_line(fault):
    text = (ROOT / fault.file).read_text(encoding="utf-8")
    assert text.count(fault.old) == 1 and "\n" not in fault.old
    assert fault.new != fault.old
    assert all((ROOT / path).exists() for path in fault.tests.split())
