"""A sequence format of one's own: ``slam run FOLDER --format pairs_format:open_folder`` in the folder of this file.

FOLDER holds ``a/1.50.png``, ``b/1.50.png`` … (left, right, named by their times [s]) and ``rig.yaml``.
"""

import numpy as np

from slam.sequences.base import RecordedSequence
from slam.sequences.pairs import Listing, open_images
from slam.sequences.rigs import calibration_files, read_rig


def open_folder(folder, options, faults):
    """A sequence of a folder; ``options`` are those behind its ``?``, and ``faults.report(kind, line)`` warns."""
    sides = []
    for name in ("a", "b"):
        files = sorted((folder / name).glob("*.png"), key=lambda file: float(file.stem))  # stamps must increase
        stamps = np.array([round(1e9 * float(file.stem)) for file in files])  # [ns]
        sides.append(Listing(folder / name, stamps, [file.name for file in files], stamped=True))
    pairs, decode, size = open_images(sides, options, faults)  # pairs them by stamp, and reads one pair
    own = [[folder / "rig.yaml"]]  # sets of files, each complete by itself; the first that is there counts
    rig = read_rig(calibration_files(folder, options, own), size, options)
    return RecordedSequence(folder.name, "pairs", options.get("kind", "handheld"), rig, pairs.stamps, decode)
