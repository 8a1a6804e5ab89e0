"""A front end of OpenCV's ORB: features of both images, matched along the rows of the rectified pair."""

import cv2
import numpy as np

from slam.data import StereoFeatures


class OrbFront:
    def __init__(self, rig, features=1500):
        self.maps, self.orb = rig.rectified.maps, cv2.ORB_create(features)

    def found(self, image, side):
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        points, bits = self.orb.detectAndCompute(cv2.remap(grey, *self.maps[side], cv2.INTER_LINEAR), None)
        signs = np.unpackbits(bits, axis=1) * 2.0 - 1 if points else np.zeros((0, 256))
        looks = np.column_stack([signs / 32, np.full(len(signs), np.sqrt(0.75))])  # n other bits: √n / 16 apart
        return points, np.array([p.pt for p in points]).reshape(-1, 2), looks.astype(np.float32)

    def extract(self, frame):
        points, uv, looks = self.found(frame.left, 0)
        right = np.full_like(uv, np.nan)
        there, other = (uv[:0], looks[:0]) if frame.right is None else self.found(frame.right, 1)[1:]
        if len(uv) and len(there):
            rows, disparities = np.abs(uv[:, None, 1] - there[:, 1]), uv[:, None, 0] - there[:, 0]
            alike = np.where((rows < 2) & (disparities > 0), looks @ other.T, -1.0)
            best = alike.argmax(axis=1)
            sure = (alike.max(axis=1) > 0.9) & (alike.argmax(axis=0)[best] == np.arange(len(uv)))  # both ways
            right[sure] = there[best[sure]]
        size, angle, response = np.array([(p.size, np.radians(p.angle), p.response) for p in points]).reshape(-1, 3).T
        signs = np.ones(len(uv), np.int8)  # of the Laplacian: ORB has none
        return StereoFeatures(frame.stamp, uv, right, size, angle, response, signs, looks, rectified=True)
