"""A ROS 2 recording of a rectified stereo sequence: ``python write_bag.py recording walk`` writes the folder walk."""

import sys

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

import slam

store = get_typestore(Stores.ROS2_HUMBLE)
Time, Header, Image, CameraInfo, Region = (
    store.types[f"{package}/msg/{name}"]
    for package, name in [
        ("builtin_interfaces", "Time"),
        ("std_msgs", "Header"),
        ("sensor_msgs", "Image"),
        ("sensor_msgs", "CameraInfo"),
        ("sensor_msgs", "RegionOfInterest"),
    ]
)


def camera_info(header, rig, baseline):
    """CameraInfo of rectified images: no distortion D, no turn R, and the baseline [m] in P of the right camera."""
    P = np.column_stack([rig.left.K, [-rig.left.fu * baseline, 0, 0]])
    K, R, D = rig.left.K.ravel(), np.eye(3).ravel(), np.zeros(5)
    return CameraInfo(header, rig.height, rig.width, "plumb_bob", D, K, R, P.ravel(), 0, 0, Region(0, 0, 0, 0, False))


sequence = slam.open_sequence(sys.argv[1])
if not sequence.rig.is_rectified:
    sys.exit("its images are not rectified: as image_rect they would give a wrong path")
with Writer(sys.argv[2], version=9) as bag:
    topics = {
        (side, name): bag.add_connection(f"/stereo/{side}/{name}", kind.__msgtype__, typestore=store)
        for side in ("left", "right")
        for name, kind in (("image_rect", Image), ("camera_info", CameraInfo))
    }
    for frame in sequence:
        time = round(frame.stamp * 1e9)  # [ns]
        header = Header(Time(*divmod(time, 10**9)), "stereo")
        for side, image, baseline in (("left", frame.left, 0.0), ("right", frame.right, sequence.rig.baseline)):
            pixels = Image(header, *image.shape, "mono8", 0, image.shape[1], image.ravel())
            for name, message in (("image_rect", pixels), ("camera_info", camera_info(header, sequence.rig, baseline))):
                bag.write(topics[side, name], time, store.serialize_cdr(message, message.__msgtype__))
