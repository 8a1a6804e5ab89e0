"""The path of a stereo camera while it moves: ``python webcam.py camera:0`` beside calibration.yaml; Ctrl-C ends it."""

import sys

import slam

slam.warm_up("ekf")  # the first frames do not wait for kernels then
camera = slam.open_sequence(sys.argv[1])
live = slam.LiveFrames(camera)  # the newest frame; older ones are dropped
system = slam.StereoSlam(camera.rig, backend="ekf", kind=camera.kind)
try:
    for _, result in system.run(live):
        x, y, z = result.estimate.T_world_left[:3, 3]
        print(f"{result.status.value:9} {x:7.3f} {y:7.3f} {z:7.3f} m, {live.dropped} frames dropped", flush=True)
except KeyboardInterrupt:
    pass
system.trajectory().write_tum("path.txt")
