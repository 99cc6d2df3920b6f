"""Link profiles in TOML: the shape is in docs/link.md."""

from __future__ import annotations

import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from .band import (
    IP_UDP_HEADER_BYTES,
    Band,
    BurstLoss,
    DirectionProfile,
    JitterShape,
    Order,
    Profile,
    ProfileError,
)

_NS_PER_S = 1_000_000_000
_NS_PER_MS = 1_000_000

# A century. Above all it keeps out inf and nan, which TOML can write.
_Seconds = Annotated[float, Field(gt=0, le=3e9)]
_Milliseconds = Annotated[float, Field(ge=0, le=3e12)]
_Ratio = Annotated[float, Field(ge=0, le=1)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class _BurstLossTable(_Table):
    enter_bad_ratio: _Ratio
    leave_bad_ratio: _Ratio
    bad_loss_ratio: _Ratio = 1.0
    good_loss_ratio: _Ratio = 0.0


class _BandTable(_Table):
    duration_s: _Seconds
    rate_bps: Annotated[int, Field(ge=0)]
    one_way_delay_ms: _Milliseconds
    loss_ratio: _Ratio = 0.0
    jitter_ms: _Milliseconds = 0.0
    jitter_shape: Annotated[JitterShape, Field(strict=False)] = JitterShape.HALF_NORMAL
    duplicate_ratio: _Ratio = 0.0
    reorder: bool = False
    corrupt_ratio: _Ratio = 0.0
    burst_loss: _BurstLossTable | None = None

    def to_band(self) -> Band:
        return Band(
            duration_ns=round(self.duration_s * _NS_PER_S),
            rate_bps=self.rate_bps,
            one_way_delay_ns=round(self.one_way_delay_ms * _NS_PER_MS),
            loss_ratio=self.loss_ratio,
            jitter_ns=round(self.jitter_ms * _NS_PER_MS),
            jitter_shape=self.jitter_shape,
            duplicate_ratio=self.duplicate_ratio,
            reorder=self.reorder,
            corrupt_ratio=self.corrupt_ratio,
            burst_loss=None if self.burst_loss is None else BurstLoss(**self.burst_loss.model_dump()),
        )


class _DirectionTable(_Table):
    """Everything is optional: what a direction does not say, the top of the file says."""

    band: list[_BandTable] | None = None
    cyclic: bool | None = None
    buffer_s: _Seconds | None = None
    buffer_bytes: Annotated[int, Field(gt=0)] | None = None
    buffer_packets: Annotated[int, Field(gt=0)] | None = None
    overhead_bytes: Annotated[int, Field(ge=0)] | None = None
    minimum_bytes: Annotated[int, Field(ge=0)] | None = None
    mtu_bytes: Annotated[int, Field(gt=0)] | None = None
    order: Annotated[Order, Field(strict=False)] | None = None


class _ProfileTable(_DirectionTable):
    name: str | None = None
    description: str = ""
    source: str = ""
    down: _DirectionTable = _DirectionTable()
    up: _DirectionTable = _DirectionTable()


def read_profile(path: Path) -> Profile:
    """The profile in a TOML file; its name is the file's unless the file says another.

    Raises ProfileError, which names file, field, value and bound.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ProfileError(f"{path}: the link profile cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProfileError(f"{path}: the link profile is not TOML: {error}.") from error
    return profile_from_dict(values, where=str(path), name=path.stem)


def profile_from_dict(values: dict[str, Any], *, where: str, name: str) -> Profile:
    """The profile in an already parsed file, or as profile_to_dict made it. Raises ProfileError."""
    try:
        table = _ProfileTable.model_validate(values)
    except ValidationError as error:
        raise ProfileError("\n".join(_sentence(where, detail) for detail in error.errors())) from error
    if table.band is not None and table.down.band is not None and table.up.band is not None:
        raise ProfileError(f"{where}: band is never used, as down.band and up.band both replace it.")
    try:
        return Profile(
            name=table.name or name,
            down=_direction(table, table.down, "down"),
            up=_direction(table, table.up, "up"),
            description=table.description,
            source=table.source,
        )
    except ProfileError as error:
        raise ProfileError(f"{where}: {error}") from error


def profile_to_dict(profile: Profile) -> dict[str, object]:
    """The resolved profile in the shape of the file, every value written out, to save beside a result."""
    return {
        "name": profile.name,
        "description": profile.description,
        "source": profile.source,
        "down": _direction_to_dict(profile.down),
        "up": _direction_to_dict(profile.up),
    }


def _direction(top: _ProfileTable, own: _DirectionTable, which: str) -> DirectionProfile:
    bands = own.band if own.band is not None else top.band
    if not bands:
        raise ProfileError(
            f"{which}.band has no entry; give [[band]] for both directions or [[{which}.band]]."
        )

    def said(field: str, default: Any) -> Any:
        for table in (own, top):
            if getattr(table, field) is not None:
                return getattr(table, field)
        return default

    buffer_s = said("buffer_s", None)
    return DirectionProfile(
        bands=tuple(band.to_band() for band in bands),
        cyclic=said("cyclic", False),
        buffer_ns=None if buffer_s is None else round(buffer_s * _NS_PER_S),
        buffer_bytes=said("buffer_bytes", None),
        overhead_bytes=said("overhead_bytes", IP_UDP_HEADER_BYTES),
        buffer_packets=said("buffer_packets", None),
        minimum_bytes=said("minimum_bytes", 0),
        mtu_bytes=said("mtu_bytes", None),
        order=said("order", Order.RATE_THEN_DELAY),
    )


def _direction_to_dict(direction: DirectionProfile) -> dict[str, object]:
    values: dict[str, object] = {
        "cyclic": direction.cyclic,
        "overhead_bytes": direction.overhead_bytes,
        "minimum_bytes": direction.minimum_bytes,
        "order": direction.order.value,
        "band": [_band_to_dict(band) for band in direction.bands],
    }
    if direction.buffer_ns is not None:
        values["buffer_s"] = direction.buffer_ns / _NS_PER_S
    for name in ("buffer_bytes", "buffer_packets", "mtu_bytes"):
        if getattr(direction, name) is not None:
            values[name] = getattr(direction, name)
    return values


def _band_to_dict(band: Band) -> dict[str, object]:
    values: dict[str, object] = {
        "duration_s": band.duration_ns / _NS_PER_S,
        "rate_bps": band.rate_bps,
        "one_way_delay_ms": band.one_way_delay_ns / _NS_PER_MS,
        "loss_ratio": band.loss_ratio,
        "jitter_ms": band.jitter_ns / _NS_PER_MS,
        "jitter_shape": band.jitter_shape.value,
        "duplicate_ratio": band.duplicate_ratio,
        "reorder": band.reorder,
        "corrupt_ratio": band.corrupt_ratio,
    }
    if band.burst_loss is not None:
        values["burst_loss"] = asdict(band.burst_loss)
    return values


def _sentence(where: str, detail: Any) -> str:
    """One error of pydantic's as "link.toml: band.0.rate_bps = -5: input should be ..."."""
    field = ".".join(str(part) for part in detail["loc"])
    message = detail["msg"][0].lower() + detail["msg"][1:]
    if detail["type"] == "missing":
        return f"{where}: {field}: {message}."
    return f"{where}: {field} = {detail['input']!r}: {message}."
