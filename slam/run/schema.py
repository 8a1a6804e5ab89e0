"""What the files of a run hold: every column with its unit, frame and meaning. Headers are taken from here."""

from __future__ import annotations

from typing import Any, NamedTuple

#: Stages of a step, in their order, and what each does: columns ``ms_…`` of frames.csv.
STAGE_NAMES = {
    "read": "reading images",
    "extract": "features",
    "predict": "prediction",
    "associate": "data association",
    "update": "update",
    "estimate": "estimate and covariances",
    "objects": "moving objects",
    "manage": "map management",
    "atlas": "places and loops",
}
STAGES = tuple(STAGE_NAMES)

#: Colours of bodies (red, green, blue); none is that of a path, a landmark or a loop. Further bodies have them paler,
#: then darker.
_BODY_COLOURS = (216, 27, 96), (142, 36, 170), (0, 137, 123), (109, 76, 65), (130, 119, 23)
_SHADES = (0.0, 255.0), (0.5, 255.0), (0.5, 0.0)  # how far towards white or black


def body_colour(body: int) -> tuple[int, int, int]:
    """The colour (red, green, blue) of a moving body in images, maps and the viewer, by its id."""
    again, which = divmod(body - 1, len(_BODY_COLOURS))
    share, grey = _SHADES[again % len(_SHADES)]
    red, green, blue = (round(part + share * (grey - part)) for part in _BODY_COLOURS[which])
    return red, green, blue


#: Frames of coordinates.
FRAMES = {
    "world": "the left camera's axes in the first frame, x right, y down, z forward; in a prior map, the map's world",
    "body": "fixed to a moving body; when it is found the axes are the world's, the origin is the mean of its points",
}


class Column(NamedTuple):
    """A column: name, unit (empty for counts, words and ratios), what it holds, in which frame of coordinates."""

    name: str
    unit: str
    text: str


def _upper(prefix: str, names: str) -> str:
    """Names of a symmetric matrix's upper triangle, row by row."""
    return " ".join(f"{prefix}{a}{b}" for i, a in enumerate(names) for b in names[i:])


def _table(*rows: str) -> tuple[Column, ...]:
    """Rows of ``names | unit | meaning``; columns whose names stand in one row share unit and meaning."""
    cells = ([cell.strip() for cell in row.split("|")] for row in rows)
    return tuple(Column(name, unit, text) for names, unit, text in cells for name in names.split())


_POSE = _table(
    "stamp | s | time of the frame",
    "x y z | m | position of the left camera in the world",
    "qx qy qz qw | | unit quaternion that turns camera coordinates to world coordinates",
)

_POSE_COVARIANCE = (
    f"{_upper('c', '012345')} | rad², rad·m, m² | covariance of the pose, upper triangle row by row: 0 to 2 rotation "
    "about x, y, z, 3 to 5 translation along x, y, z, both"
)

FRAME_TABLE = _table(
    "frame | | number of the frame in the sequence",
    "stamp | s | time of the frame",
    "status reason | | started, tracked, predicted, lost or failed; and why, where it is not tracked",
    "features stereo | | number of features in the left image; of those matched in the right image",
    "predicted matched | | number of landmarks predicted to be in view; of those matched to a feature",
    "used rejected | | number of matches that the back end used; that it rejected",
    "added erased map_size | | number of landmarks added; erased; in the map after the frame",
    "keyframe loop refused | | 1 for a keyframe, else 0; the earlier frame of the same place, where a loop is closed "
    "(`map`: it is in the prior map); the same for a loop that is refused because it contradicts the path",
    "D_threshold | | threshold of the SURF detector (paper A, III.A)",
    "nis nis_dof | | normalised innovation squared of the measurements used, and its degrees of freedom",
    "sd_x sd_y sd_z | m | standard deviations of the position, along the axes of the world",
    "sd_rotation | rad | standard deviation of the orientation, all three axes together",
    f"{_POSE_COVARIANCE} in the camera's axes, perturbing the pose on the right",
    *(f"ms_{stage} | ms | wall time of a stage: {text}" for stage, text in STAGE_NAMES.items()),
)

LANDMARK_TABLE = _table(
    "id | | of the landmark",
    "x y z | m | position in the world",
    f"{_upper('c', 'xyz')} | m² | covariance of the position, upper triangle row by row",
    "seen last_seen | | number of frames it was measured in; the last of them, empty for none",
)

OBJECT_TABLE = _table(
    "frame | | number of the frame in the sequence",
    "stamp | s | time of the frame",
    "id | | of the body; it keeps it through stops and occlusions",
    "moving measured | | 1 where the body moves now, else 0; 1 where it was measured in this frame, else 0",
    "last_measured | s | time of the last frame in which it was measured; empty where that is not known",
    "existence | | probability that it exists",
    "x y z | m | position of the body's origin in the world",
    "roll pitch yaw | rad | orientation, from body to world axes: R = Rz(yaw) Ry(pitch) Rx(roll)",
    "vx vy vz | m/s | velocity of the body's origin, along the axes of the world",
    "wx wy wz | rad/s | angular velocity, along the axes of the world",
    "motion_x motion_y motion_z | m | motion since the frame before: a point of the body went from p to R p + t in "
    "the world; this is t",
    "motion_roll motion_pitch motion_yaw | rad | R of that motion",
    f"{_POSE_COVARIANCE} in body axes, perturbing the pose on the right",
)

#: Landmarks that had left the map before the end.
OLD_LANDMARKS = "landmarks_old.csv"

OLD_TABLE = LANDMARK_TABLE[:4]  # id, x, y, z

#: Files that are tables, with their columns.
TABLES: dict[str, tuple[Column, ...]] = {
    "trajectory.txt": _POSE,
    "trajectory_final.txt": _POSE,
    "truth.txt": _POSE,
    "frames.csv": FRAME_TABLE,
    "landmarks.csv": LANDMARK_TABLE,
    OLD_LANDMARKS: OLD_TABLE,
    "objects.csv": OBJECT_TABLE,
}

#: Files of a run, with what each is for.
FILES = {
    "trajectory.txt": "the online path, as estimated frame by frame; columns apart by spaces (TUM)",
    "trajectory_final.txt": "the path as the back end sees it at the end: a smoother revises the past, a filter not",
    "truth.txt": "the true path at the same stamps, in its own world, where the sequence has one",
    "frames.csv": "a row per frame",
    "landmarks.csv": "a row per landmark of the map at the end",
    OLD_LANDMARKS: "a row per landmark that had left the map by then, where the last keyframe that saw it has it",
    "objects.csv": "a row per frame and moving body",
    "summary.json": "counts, accuracy and consistency where the truth is known, timings; written last",
    "config.json": "what was run: the command, with all settings",
    "schema.json": "columns with units and meanings",
    "summary.png": "a picture of the run",
}


def header(table: tuple[Column, ...]) -> tuple[str, ...]:
    """Names of all columns of a table."""
    return tuple(column.name for column in table)


def schema() -> dict[str, Any]:
    """The contents of ``schema.json``."""
    files: dict[str, dict[str, Any]] = {name: {"meaning": text} for name, text in FILES.items()}
    for name, table in TABLES.items():
        files[name]["columns"] = [{"name": c.name, "unit": c.unit, "meaning": c.text} for c in table]
    return {"files": files, "frames": FRAMES}
