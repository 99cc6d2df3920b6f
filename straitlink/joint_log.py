"""Which joints a log's joint states tell."""

from __future__ import annotations

from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader

from messages.payload import PayloadError
from messages.payload.bounded import canonical
from messages.payload.joints import FORMS
from straitlink.schemas import PayloadType, zenoh_encoding


def joint_names_in(log: Path, topic: str | None = None) -> tuple[str, ...]:
    """The names in the first message of a topic with joint states, in their order; by default the first such.

    Raises PayloadError for a log without one.
    """
    try:
        with log.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages(topics=topic):
                name = "" if schema is None else schema.name
                form = FORMS.get(canonical(zenoh_encoding(PayloadType(channel.message_encoding, name))))
                if form is not None:
                    return form[0](message.data).names
    except McapError as error:
        raise PayloadError(f"{log}: is no whole MCAP file: {error}") from error
    where = log if topic is None else f"{log}, topic {topic}"
    raise PayloadError(f"{where}: has no joint states; expected one of {', '.join(FORMS)}")
