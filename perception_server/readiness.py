"""What the server can draw at once, while the rest is still being compiled."""

from __future__ import annotations

from dataclasses import dataclass

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_NO_DATA, Image, ImageRequest, View, ViewRequest

WARMING_UP = "warming up: "  # begins the error of a reply that should be asked for again
_GEOMETRY = (
    f"{WARMING_UP}what draws views of geometry is being compiled, once on this machine, "
    "within a minute or two; ask again in 5 s"
)


@dataclass(slots=True)
class Readiness:
    """Set by the thread that warms up, read by the one that renders. True: compiled, or never to be waited
    for."""

    pictures: bool = True
    geometry: bool = True

    def for_now(self, request: ImageRequest) -> ImageRequest:
        """The request, with plain JPEGs instead of packed ones while what packs them is not ready."""
        if self.pictures or request.HasField("format"):
            return request
        plain = ImageRequest()
        plain.CopyFrom(request)
        plain.format = ImageRequest.FORMAT_JPEG
        return plain

    def geometry_not_yet(self, request: ViewRequest) -> View | None:
        """The reply to a request that would wait for the compiler; None once it would not."""
        if self.geometry:
            return None
        return View(request_id=request.request_id, status=VIEW_STATUS_NO_DATA, error=_GEOMETRY)


def is_warming_up(reply: View | Image) -> bool:
    """Whether a reply says that its request should be put again in a few seconds."""
    return reply.status == VIEW_STATUS_NO_DATA and reply.error.startswith(WARMING_UP)
