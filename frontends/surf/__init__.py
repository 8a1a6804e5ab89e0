"""The modified SURF of paper A: detector, descriptors, stereo matching, front end."""

from __future__ import annotations

from frontends.surf.config import SurfConfig
from frontends.surf.frontend import SurfFrontend
from frontends.surf.keypoints import Keypoints
from frontends.surf.surf import Surf

#: As ``cv2.xfeatures2d.SURF_create``, see `Surf.create`.
create = Surf.create

__all__ = ["Keypoints", "Surf", "SurfConfig", "SurfFrontend", "create"]
