"""``python -m slam``: the command ``slam``."""

import sys
from pathlib import Path

from slam.commands.cli import main

OWN = Path(__file__).resolve().parents[1]  # where `slam` itself is from

if Path(sys.path[0]) == Path.cwd() != OWN:  # as with `slam`: last, so that folders here hide nothing of ours
    sys.path.append(sys.path.pop(0))
main()
