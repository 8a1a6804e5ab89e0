"""What the columns and pictures of the results page say, for whoever reads the page first."""

from __future__ import annotations

from itertools import pairwise

#: By the name of the column, on the whole page.
EVERYWHERE = {
    "tracked": "frames whose pose was measured against the map; the first frame, where the map begins, counts as well",
    "ATE online [m]": "absolute trajectory error: RMSE of the positions as given frame by frame, after alignment",
    "ATE online [cm]": "absolute trajectory error: RMSE of the positions as given frame by frame, after alignment",
    "ATE [mm]": "absolute trajectory error: RMSE of the positions as given frame by frame, after alignment",
    "ATE final [m]": "the same of the path as it is known at the end",
    "right associations [%]": "matches of a feature with the landmark that it really shows",
    "NIS/dof": "squared innovations over their claimed variance, per degree of freedom; 1 is right, less is cautious",
    "NEES": "squared errors over the claimed covariance: 6 is right for a pose; more means errors larger than claimed",
    "rejected": "observations that the back end left out as wrong",
    "landmarks": "in the map at the end",
    "D_threshold": "least determinant of the Hessian at a feature (paper A, III.A)",
    "paper A": "the paper's figure",
}

#: By experiment, where they mean something else or are its own; columns that need no words are in neither.
OF_ONE = {
    "detector": {
        "octave 1": "features found in this octave, whose radii are twice those of the one before",
        "ms, 1 octave": "time to detect them in the first octave alone, and in two [ms]",
    },
    "descriptors": {
        "16-D [ms]": "time to describe so many features with 16 or 64 dimensions",
        "saved": "time that 16 dimensions save",
    },
    "aisle": {
        "mean error [cm]": "distance of the online position from the truth, in the frame of the first pose",
        "end [cm]": "the same in the last frame",
        "final mean [cm]": "the same of the path as it is known at the end",
        "doubled": "pairs of landmarks that look like one, which was put into the map twice",
    },
    "ablation": {
        "error": "first row: ATE online [m], of the library the error of distances of places seen twice [m]; below: "
        "how many times that of the first row, median of the runs; bold where all runs agree that it is more, or less",
        "mean ratio": "geometric mean over the sequences",
        "lost": "frames without a measured pose, all runs together; below: more or fewer than in the first row",
        "CPU": "time of a step without extraction of features, over that of the first row; median",
        "NEES": "of relative poses over 10 m on drives, else 1 m: 6 is right, more means errors larger than claimed",
    },
    "startup": {
        "pixels": "what is measured: both images (stereo), the left one, or both by the back end alone (no search)",
        "start [cm]": "where the system is told that it stands",
        "frame 0 [cm]": "error of the position after the first frame",
        "mean after [cm]": "from frame 10 on",
        "1 sigma at the end [cm]": "claimed standard deviation of the position",
    },
    "walking_robot": {
        "ATE online [mm]": "RMSE of the positions as given frame by frame, after alignment",
        "ATE final [mm]": "the same of the path as it is known at the end",
        "path [m]": "its length as estimated",
        "NEES / 6": "squared errors over the claimed covariance; 1 is right, more means errors larger than claimed",
    },
    "moving_objects": {
        "mode": "detect: found without being told; procedure1: the papers' procedure, which is told the box's features",
        "place": "of the box, as in paper B",
        "frames": "in which its pose was measured there; of KITTI: the first and the last",
        "ATE [mm]": "RMSE of the camera's positions after alignment",
        "camera NEES": "squared errors of the camera's pose over its claimed covariance; 6 is right",
        "precision": "features labelled moving that are",
        "recall": "moving features that are labelled so",
        "F1": "the harmonic mean of both",
        "false moving per 1000 still": "features of the still world that are labelled moving",
        "counted right": "share of the frames in which exactly the bodies in view are measured, each once",
        "false objects [frames]": "for how many frames each object lived that is none",
        "false objects": "objects that are none, in all runs together",
        "longest [frames]": "for how long the longest of them lived",
        "objects [ms]": "median time of the detector in a frame",
        "ATE without the box [mm]": "the camera's error where the box's features are taken away",
        "coverage": "share of the frames in view in which the body is measured",
        "ids": "how many objects it was in turn; 1 is right",
        "delay [frames]": "from its first motion to its detection",
        "ME [deg]": "motion error: of the body's motion from frame to frame, median; also in mm",
        "absolute [deg]": "error of its pose, after one alignment of body frames in a run, median; also in mm",
        "NEES": "squared errors of its pose over the claimed covariance; 6 is right",
        "smoother less ekf": "mean difference with its 95 % interval",
        "p": "of a permutation test",
        "verdict": "hint up to p = 0.1, likely up to 0.05, certain up to 0.05 after Holm's adjustment; else open",
        "one id": "runs in which the box has one id before and the same after",
        "other ids": "new ids that were given to it",
        "car": "number in KITTI's labels",
        "speed within 25 m [m/s]": "median while it is nearer than that",
        "GPS distance RMSE [m]": "of the camera's path in the plane from GPS positions",
        "first frame": "of the recording with which the run begins",
        "cyclist": "number in KITTI's labels",
        "frames within 25 m": "in which the middle of the label's bottom is in the image and nearer than that",
        "not measured [rows]": "rows of objects.csv that are predicted only, of so many rows",
    },
    "consistency": {
        "online [mm]": "RMSE of the newest pose, over the runs",
        "/ bound": "the error over the Cramér-Rao bound, which no unbiased estimator beats on average; 1 is best",
        "final [mm]": "RMSE of the whole path as it is known at the end",
        "NEES (95 %)": "mean over the runs, with the band that 95 % of such means lie in if the covariances are right",
        "frames inside": "whose mean NEES lies in the band",
        "leaves at": "frame from which it stays above the band",
        "NIS/dof": "of the updates, with its band; 1 less what the gate cuts off is right",
        "pixel NIS": "of predicted left pixels; 2 is right, less: the path is smoother than the model expects",
        "landmark NEES": "of the landmarks' positions; 3 is right",
        "with 10 % wrong": "the same error where a tenth of the matches are wrong",
    },
    "long_run": {
        "memory [MB]": "of the process",
        "beyond start and trajectory [MB]": "what of it neither the interpreter nor the path takes",
        "measured": "landmarks in a frame, mean",
        "least eigenvalue": "of the correlation matrix; above 0 is right",
        "no Cholesky": "times that the covariance was not positive definite",
        "failed": "updates",
        "error [m]": "of the position",
        "NEES (6)": "of the pose; 6 is right",
        "below 95 %": "frames whose NEES lies below the 95 % quantile; 95 % is right",
    },
    "policies": {
        "mean error [cm]": "distance of the online position from the truth; median over the seeds, as in all columns",
        "worst peak [cm]": "largest peak of all seeds",
        "measured a frame": "landmarks, mean",
        "measured, bare stretch": "the same where the camera passes the bare wall",
        "least measured": "in any frame",
    },
    "faults": {
        "states": "of the frames, in their order",
        "error before [cm]": "distance of the online position from the truth, mean before the fault",
        "frames until relocalised": "from the fault's end until the pose was measured again",
        "added while lost": "landmarks; none should be",
    },
    "starry_night": {
        "steps": "of the recording; each row is a run of its own",
        "updates ok / empty / failed": "empty: no landmark was in view",
        "rejected": "observations that were left out as wrong",
        "RMSE online [m]": "of the path from the true first pose on, without alignment; then of its rotation [deg]",
        "ATE aligned [m]": "of the online path, after alignment",
        "landmarks [m]": "RMSE of their positions",
        "median NEES": "6 is right; from step 0 the attitude is hardly known, and no Gaussian describes it",
        "within 3 sigma [%]": "share of the errors of single axes, turn and position, that are less than three sigma",
    },
    "calibration": {
        "ATE, right [m]": "of the online path with the right calibration; median over the seeds, as in all columns",
        "ATE, wrong [m]": "the same with the wrong one, which is corrected while the system runs",
        "ratio": "of the two",
        "ATE, not calibrated [m]": "with the wrong one and no self-calibration",
        "focal length [%]": "correction found, and its standard deviation, as in the three columns that follow",
        "largest error [sigma]": "of these four, in all seeds",
        "apart [sigma]": "difference without the prior; – where a drive says less than the prior",
    },
    "residuals": {
        "landmarks": "with four measurements or more",
        "life, median [frames]": "number of measurements of these",
        "after 1": (
            "change of uL's error over one frame, over √2 [px]; the four columns that follow: over so many. The "
            "same in all if errors are independent"
        ),
        "residual [px]": "root mean square error about the landmark that fits best",
        "pixel_sigma [px]": "of the models, as if errors were independent",
        "NIS/dof": "1 if pixels alone mattered; less is the price of errors that last",
    },
    "real_sequences": {
        "NEES over 1 m": "of relative poses: squared errors over the claimed covariance; 6 is right, less is cautious",
        "NEES over 10 m": "the same; the truth's own errors are counted, as the truth itself shows them",
        "landmark lifetime, median [frames]": "how long a landmark stays in the map",
        "ms per frame": "median, on the machine that made this page",
    },
    "recorded_tracks": {
        "right pixels moved [px]": (
            "for a rig whose calibration is off: −0.19 px is what the self-calibration finds on the images of this "
            "drive (KITTI odometry 06)"
        ),
        "wrong": "share of the observations that were given the pixels of another track, others with each seed",
        "segment error online [%]": (
            "error over stretches of 100 to 800 m, by their length (KITTI's measure): the median of the seeds, and the "
            "smallest and the largest"
        ),
        "path too long [%]": "length of the online path against the true one's",
        "rebuilds": "how often the smoother was rebuilt",
    },
    "loops": {
        "path": "number of KITTI's recording whose true path is driven",
        "keyframes": "in which places are remembered",
        "false": "loops closed between places that are not the same, or with a wrong pose",
        "refused": "loops that did not agree with the path and its covariance",
        "places found again [%]": "share of the stretches driven again on which a loop was closed",
        "ATE without [m]": "error of the online path without loops: RMSE of the positions after alignment",
        "online [m]": "the same with loops, as given frame by frame",
        "final [m]": "the same of the path as it is known at the end",
        "final length [%]": "by how much that path is too long",
        "without, scale fitted [m]": "ATE without loops after alignment with scale",
        "final, scale fitted [m]": "the same of the path as it is known at the end",
        "error at the last loop [m]": "of the position in that frame, from the start of the path",
        "its 3σ [m]": "what is claimed of it",
        "NEES before loops": "mean of the online poses before the first loop; 6 is right",
        "memory [kB a frame]": "that each frame leaves; – where it was not measured",
        "ATE bounded [mm]": "error of the smoother that keeps the last 50 poses; full: of one that keeps all; medians",
        "difference, median [%]": "of bounded against full, seed by seed; least and most: of all seeds",
        "last frames bounded [CPU ms]": "time of a frame at the end",
        "to check one more [CPU ms]": "to compare a keyframe with so many others",
    },
    "frame_rate": {
        "frames per second": "of the frames that are taken; the others are left out",
        "tracked [%]": "frames whose pose was measured, median over the seeds",
    },
}  # fmt: skip


#: By experiment and name of the picture.
PICTURES = {
    "detector": {
        "detector": "Left: features found with a threshold, by octave. Middle: time to detect them. Right: their radii."
    },
    "descriptors": {
        "descriptors": "Left: time of description. Right: error of the map's points, a line for each seed of a world."
    },
    "aisle": {
        "errors": "Error of the position along the world's axes, and three times its claimed standard deviation.",
        "map": "Threshold of the detector, landmarks measured, and landmarks in the map over time.",
        "map_3d": "The map at the end with ellipsoids of two standard deviations (paper A, Fig. 5).",
        "top_view": "The map from above with ellipses of two standard deviations (paper A, Fig. 6).",
    },
    "startup": {
        "startup": "Left and middle: from three wrong starts to the true place in one frame. Right: the error then."
    },
    "walking_robot": {
        "map_3d": "The map at the end with ellipsoids of two standard deviations (paper B, Fig. 8).",
        "errors": "Error of the position along the world's axes, and three times its claimed standard deviation.",
    },
    "moving_objects": {"box": "Error of the box's pose while it moves and rests, body frames aligned once."},
    "consistency": {
        "consistency": "Above: error of the newest position and the bound. Below: NEES of its pose and the 95 % band."
    },
    "long_run": {"long_run": "Time, memory, least eigenvalue and NEES along the runs."},
    "policies": {"policies": "Mean error of each seed (dots) and its median (lines)."},
    "faults": {"faults": "Error of the position, frame by frame; the fault is grey."},
    "informative": {"informative": "Error of the path over the number of matches that the back end is given."},
    "starry_night": {"starry_night": "Landmarks in view, and the error of each run's position."},
    "loops": {"loops": "Paths from above: true, without loops, and at the end with loops; circles: loops closed."},
    "recorded_tracks": {"recorded_tracks": "Paths from above; all begin at the same pose, nothing is aligned."},
    "real_sequences": {"paths": "Paths from above, aligned with the true ones."},
}


def caption(experiment: str, picture: str) -> str:
    """What a picture shows; empty where nothing is said of it."""
    return PICTURES.get(experiment, {}).get(picture, "")


def explained(experiment: str, printed: str) -> str:
    """What the columns of an experiment's tables say, in their order; empty where all speak for themselves."""
    known = EVERYWHERE | OF_ONE.get(experiment, {})
    lines = printed.splitlines()
    heads = [line for line, below in pairwise(lines) if below.startswith("|-") or below.startswith("| -")]
    columns = dict.fromkeys(cell.strip() for head in heads for cell in head.strip("|").split("|"))
    found = [f"- **{column}**: {known[column]}" for column in columns if column in known]
    head = ["<details markdown>", "<summary>What the columns say</summary>", ""]
    return "\n".join([*head, *found, "", "</details>"]) if found else ""
