"""The path of a stereo camera from two streams of plain arrays, wherever they come from."""

import slam


def follow(lefts, rights, stamps, K, baseline):
    """Rectified images (H, W), uint8, and their times [s]; K is the camera matrix [px], the baseline is in metres."""
    system = None
    for left, right, stamp in zip(lefts, rights, stamps):
        if system is None:
            rig = slam.StereoRig.from_pinhole(K, baseline=baseline, size=left.shape[1::-1])
            system = slam.StereoSlam(rig, backend="ekf")
        result = system.process(left, right, stamp)
        print(stamp, result.status.value, result.estimate.T_world_left[:3, 3])
    return system.trajectory()
