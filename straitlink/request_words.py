"""A request as somebody types it: a preset, then field=value pairs."""

from __future__ import annotations

from collections.abc import Sequence

from messages.proto.straitlink.view_pb2 import ImageRequest, ViewRequest
from perception_server.bus_messages import RequestType, request_from_fields
from perception_server.dispatch import Request
from perception_server.errors import RequestError
from perception_server.image_wish import IMAGE_PRESETS
from perception_server.sensors import check_request
from perception_server.view_presets import VIEW_PRESETS

_KINDS: dict[str, RequestType] = {"image": ImageRequest, "view": ViewRequest}
_REGION = ("x_px", "y_px", "width_px", "height_px")


def request_of(words: Sequence[str]) -> Request:
    """["head_low", "quality=40"] as a checked request. Raises RequestError that names the field."""
    kind: RequestType | None = None
    fields: dict[str, object] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if equals:
            fields[name] = _regions(value) if name == "chips" else value
        elif kind is None and not fields and word in _KINDS:
            kind = _KINDS[word]
        elif "preset" not in fields:
            fields["preset"] = word
        else:
            raise RequestError(f"{word!r}: expected field=value")
    if kind is None:
        preset = fields.get("preset", "")
        if preset and preset not in IMAGE_PRESETS and preset not in VIEW_PRESETS:
            known = ", ".join((*IMAGE_PRESETS, *VIEW_PRESETS))
            raise RequestError(f"preset = {preset!r}: must be one of {known}")
        kind = ImageRequest if preset in IMAGE_PRESETS else ViewRequest
    request = request_from_fields(kind, fields)
    if request.period_ms:
        raise RequestError(f"period_ms = {request.period_ms}: one view is requested; publish what repeats")
    check_request(request)
    return request


def _regions(text: str) -> list[dict[str, int]]:
    """ "300,200,160,120+10,20,80,60": left, top, width and height of each chip."""
    regions = []
    for each in text.split("+"):
        numbers = each.split(",")
        if len(numbers) != len(_REGION) or not all(
            number.isascii() and number.isdigit() for number in numbers
        ):
            raise RequestError(f"chips = {text!r}: expected x,y,width,height in pixels, several joined by +")
        regions.append(dict(zip(_REGION, map(int, numbers), strict=True)))
    return regions
