"""How a run is asked to end early."""

from __future__ import annotations

import threading


class Until(threading.Event):
    """Ends a run when it is set, after the present frame, as if there were no more.

    Attributes:
        ended: how the run then ended, for its summary.
    """

    ended = "ended by the user"
