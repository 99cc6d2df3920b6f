"""What can go wrong between a request and its view.

PerceptionError
+-- RequestError   a field of a request breaks its bound: the reply says REFUSED and names the field
+-- NoDataError    the history holds nothing that the request asks for: the reply says NO_DATA
+-- PoseError      no transform between two frames at a time: not known, or not known then
+-- InputError     a sensor's message that cannot be read: counted and dropped
"""

from __future__ import annotations


class PerceptionError(Exception):
    """Base of this package's errors; each message is a sentence for the operator."""


class RequestError(PerceptionError):
    """A request's field is out of its bounds; the message begins with the field's name."""


class NoDataError(PerceptionError):
    """There is nothing to render in the window, or no pose to render it from."""


class PoseError(PerceptionError):
    """Two frames are not connected, or not at the time asked for."""


class InputError(PerceptionError):
    """A message on the robot's bus is not what its configuration says."""
