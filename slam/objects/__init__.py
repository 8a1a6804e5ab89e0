"""Moving objects: found without being told, measured with covariance."""

from __future__ import annotations
