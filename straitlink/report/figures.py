"""Figures with units, as the table and the page print them."""

from __future__ import annotations

from .summary import Spread, Summary

MISSING = "\N{EN DASH}"
_COUNTERS = (
    *("offered", "decimated", "sent", "delivered"),
    *("superseded", "expired", "overflow", "refused", "stale", "unreadable", "lost"),
)
_RARE = ("refused", "stale", "unreadable")  # told only where it befell a message


def counters_told(summary: Summary) -> list[str]:
    """The counters that some trace tells of some topic; the rare ones only where they are not all 0."""
    values = {name: [getattr(row, name) for row in summary.topics] for name in _COUNTERS}
    for name in _RARE:
        if not any(values[name]):
            del values[name]
    return [name for name, column in values.items() if any(value is not None for value in column)]


def seconds(value_ns: int | None) -> str:
    """1_234_000_000 -> "1.23 s", 56_700_000 -> "57 ms"."""
    if value_ns is None:
        return MISSING
    if abs(value_ns) < 999_500_000:
        return f"{value_ns / 1e6:.0f} ms" if abs(value_ns) >= 9_950_000 else f"{value_ns / 1e6:.1f} ms"
    return f"{value_ns / 1e9:.2f} s" if abs(value_ns) < 99_995_000_000 else f"{value_ns / 1e9:.0f} s"


def spread_cells(spread: Spread | None) -> tuple[str, str, str]:
    """p50, p95 and max."""
    if spread is None:
        return MISSING, MISSING, MISSING
    return seconds(spread.p50_ns), seconds(spread.p95_ns), seconds(spread.max_ns)


def count(value: int | None) -> str:
    """1234567 -> "1,234,567"."""
    return MISSING if value is None else f"{value:,}"


def size(value_bytes: int | None) -> str:
    """1_234_567 -> "1.23 MB" (decimal)."""
    if value_bytes is None:
        return MISSING
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if value_bytes >= scale * 0.9995:
            return f"{value_bytes / scale:.3g} {unit}"
    return f"{value_bytes} B"


def rate(value_bps: float) -> str:
    """999_512 -> "1.00 Mbit/s", 95_000 -> "95.0 kbit/s"."""
    unit, scale = ("Mbit/s", 1e6) if value_bps >= 999_500 else ("kbit/s", 1e3)
    scaled = value_bps / scale
    return f"{scaled:.2f} {unit}" if scaled < 9.995 else f"{scaled:.{1 if scaled < 99.95 else 0}f} {unit}"


def percent(ratio: float | None) -> str:
    """0.956 -> "95.6 %"."""
    return MISSING if ratio is None else f"{100 * ratio:.1f} %"
