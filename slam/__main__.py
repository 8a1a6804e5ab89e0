"""``python -m slam``: the command ``slam``."""

from slam.commands.cli import main

main()
