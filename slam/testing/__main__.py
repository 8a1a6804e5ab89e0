"""``python -m slam.testing NAME``: how far a back end keeps the contract, check by check."""

from __future__ import annotations

import argparse
import sys

from slam import registry
from slam.errors import SlamError
from slam.testing import TIERS, findings


def main(arguments: list[str] | None = None) -> int:
    """Print a line for each check, and a sentence for each that fails; 1 where one does, 2 for bad input."""
    parser = argparse.ArgumentParser("python -m slam.testing", description="How far a back end keeps the contract.")
    parser.add_argument("backend", help="name of a registered back end, or my_package.my_module:MyBackend")
    parser.add_argument("--tier", choices=list(TIERS), default="good", help="the last tier to check (default: good)")
    options = parser.parse_args(arguments)
    try:
        factory = registry.resolve("backends", options.backend)
    except SlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    tier, failures = "", 0
    for finding in findings(factory, options.tier):
        if finding.tier != tier:
            tier = finding.tier
            print(tier)
        print(f"  {'fails ' if finding.failure else 'passes'}  {finding.check}")
        if finding.failure:
            failures += 1
            print(f"          {finding.failure}.\n          Asked for: {finding.demand}")
    print(f"{failures} failed" if failures else "all passed")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
