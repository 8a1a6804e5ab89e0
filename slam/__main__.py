"""``python -m slam``: the command ``slam``."""

from slam.cli import main

main()
