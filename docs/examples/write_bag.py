"""A ROS recording of a stereo sequence: ``python write_bag.py SEQUENCE walk.bag`` (ROS 1) or ``… walk`` (ROS 2)."""

import sys

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

import slam

source, target = sys.argv[1:]
ros1 = target.endswith(".bag")
store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
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


def header(time):
    """Header at a time [ns]; ROS 1 counts messages in it."""
    stamp = Time(*divmod(time, 10**9))
    return Header(0, stamp, "stereo") if ros1 else Header(stamp, "stereo")


def camera_info(header, camera, R, P):
    """CameraInfo of a camera: K and D of its images, R and P (3, 4) of the rectified ones."""
    D = np.array(camera.distortion or (0.0,) * 5)
    model = "rational_polynomial" if len(D) > 5 else "plumb_bob"
    if camera.model == "equidistant":
        model = "equidistant"
    K, R, P = camera.K.ravel(), R.ravel(), P.ravel()
    return CameraInfo(header, camera.height, camera.width, model, D, K, R, P, 0, 0, Region(0, 0, 0, 0, False))


sequence = slam.open_sequence(source)
rectified = sequence.rig.rectified
to_right = [-rectified.rig.left.fu * rectified.rig.baseline, 0, 0]  # the baseline is in P of the right camera
cameras = {
    "left": (sequence.rig.left, rectified.R_left, np.column_stack([rectified.rig.left.K, np.zeros(3)])),
    "right": (sequence.rig.right, rectified.R_right, np.column_stack([rectified.rig.left.K, to_right])),
}
image_name = "image_rect" if sequence.rig.is_rectified else "image_raw"
with rosbag1.Writer(target) if ros1 else rosbag2.Writer(target, version=9) as bag:
    topics = {
        (side, name): bag.add_connection(f"/stereo/{side}/{name}", kind.__msgtype__, typestore=store)
        for side in cameras
        for name, kind in ((image_name, Image), ("camera_info", CameraInfo))
    }
    for frame in sequence:
        time = round(frame.stamp * 1e9)
        for side, image in (("left", frame.left), ("right", frame.right)):
            pixels = Image(header(time), *image.shape, "mono8", 0, image.shape[1], image.ravel())
            for name, message in ((image_name, pixels), ("camera_info", camera_info(header(time), *cameras[side]))):
                serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
                bag.write(topics[side, name], time, serialize(message, message.__msgtype__))
