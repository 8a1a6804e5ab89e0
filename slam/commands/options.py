"""Arguments and options of the command line that several commands share, or that are long."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SequenceArgument = Annotated[
    str, typer.Argument(metavar="SEQUENCE", help="A folder, or synthetic:NAME?key=value.", show_default=False)
]
OutOption = Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for the files.")]
RunOutOption = Annotated[
    Path | None,
    typer.Option("--out", "-o", metavar="DIR", help="Folder for the files; default: results/SEQUENCE-BACKEND-N."),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace files that are there; never an input.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A setting, e.g. map.max_landmarks=300; once per setting; see `slam settings`.",
    ),
]
BackendOption = Annotated[str | None, typer.Option(metavar="NAME", help="Back end, see `slam list`; default: ekf.")]
FramesOption = Annotated[str | None, typer.Option(metavar="A:B", help="Range of frames, B left out.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no table.")]
PictureOption = Annotated[bool, typer.Option("--picture/--no-picture", help="Leave a picture of the run.")]
OptionalSequence = Annotated[
    str | None,
    typer.Argument(
        metavar="SEQUENCE",
        help="A folder, a ROS recording, camera:0, or synthetic:NAME?key=value; with --config the earlier one.",
        show_default=False,
    ),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="config.json of an earlier run, to repeat it; other options change it."),
]
FrontendOption = Annotated[str | None, typer.Option(metavar="NAME", help="Front end, see `slam list`; default: surf.")]
KindOption = Annotated[
    str | None, typer.Option(metavar="KIND", help="handheld or driving; default: the sequence's own.")
]
FormatOption = Annotated[str | None, typer.Option(metavar="FORMAT", help="Format; default: found out from the folder.")]
RecordOption = Annotated[
    Path | None, typer.Option(metavar="FILE.npz", help="Record what the back end is given, for `slam replay`.")
]
MapOption = Annotated[Path | None, typer.Option("--map", metavar="FILE", help="Start in the map of an earlier run.")]
SaveMapOption = Annotated[Path | None, typer.Option("--save-map", metavar="FILE", help="Keep the map.")]
MonoOption = Annotated[bool, typer.Option("--mono", help="Left images alone, in a prior map.")]
MaskOption = Annotated[
    str | None,
    typer.Option(metavar="FILE[,FILE]", help="Image that is black where a camera sees its own car; left, right."),
]
CalibrationOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="What is known of the rig: from `slam calibrate`, or an earlier run."),
]
ViewerOption = Annotated[
    str | None, typer.Option(metavar="live|FILE.rrd", help="Show it in Rerun, or keep it for Rerun.")
]
DrawOption = Annotated[
    Path | None, typer.Option(metavar="DIR|FILE.mp4", help="Draw landmarks and objects into the frames.")
]
DrawMapOption = Annotated[bool, typer.Option("--draw-map", help="With --draw: the growing map beside each frame.")]
OverlapOption = Annotated[
    bool, typer.Option(help="Extract the next frame's features while this one is estimated; same results.")
]
LiveOption = Annotated[
    bool, typer.Option("--live", help="Frames at their own rate; those that come too late are dropped.")
]
