"""The modified SURF of paper A: detector, descriptors, stereo matching, front end."""

from __future__ import annotations

from frontends.surf.config import SurfConfig
from frontends.surf.frontend import SurfFrontend
from frontends.surf.keypoints import Keypoints
from frontends.surf.surf import Surf

__all__ = ["Keypoints", "Surf", "SurfConfig", "SurfFrontend"]
