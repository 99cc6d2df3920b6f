"""A profile as a picture: rate and delay of both directions over time, in SVG."""

from __future__ import annotations

import math
from collections.abc import Callable
from html import escape

from .band import DirectionProfile, Profile

_WIDTH, _PANEL_HEIGHT, _LEFT, _TOP, _GAP = 900, 180, 70, 60, 50
_COLOURS = {"down": "#1f6fb2", "up": "#c2571a"}
_MAX_S = 300.0  # a longer schedule is cut
_DARK = 1e3  # bit/s: where a rate of 0 or a loss of everything is drawn


def picture(profile: Profile) -> str:
    """The first cycle, at most five minutes, as an SVG document; a blackout goes to the bottom."""
    end_s = min(_MAX_S, max(_length_s(profile.down), _length_s(profile.up)))
    rates = {name: _steps(way, end_s, _rate_bps) for name, way in _ways(profile)}
    delays = {name: _steps(way, end_s, _delay_ms) for name, way in _ways(profile)}
    highest_bps = max(value for steps in rates.values() for _, value in steps)
    lowest_bps = min(value for steps in rates.values() for _, value in steps)
    decades = (math.floor(math.log10(lowest_bps)), max(1, math.ceil(math.log10(highest_bps * 1.01))))
    highest_ms = max([1.0, *(value for steps in delays.values() for _, value in steps)])
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{2 * _PANEL_HEIGHT + 190}" '
        'font-family="sans-serif" font-size="12">',
        '<rect width="100%" height="100%" fill="white"/>',
        f'<text x="{_LEFT}" y="20" font-size="15">{escape(profile.name)}</text>',
        f'<text x="{_LEFT}" y="38" fill="#555">{escape(profile.description)}</text>',
    ]
    span = decades[1] - decades[0]
    ticks = {_rate_name(10.0**n): (n - decades[0]) / span for n in range(decades[0], decades[1] + 1)}
    parts += _panel(_TOP, "rate", ticks)
    for name, steps in rates.items():
        heights = [(at_s, (math.log10(v) - decades[0]) / span) for at_s, v in steps]
        parts.append(_line(name, heights, end_s, _TOP))
    below = _TOP + _PANEL_HEIGHT + _GAP
    parts += _panel(below, "one-way delay", {f"{highest_ms * k / 4:g} ms": k / 4 * 0.95 for k in range(5)})
    for name, steps in delays.items():
        parts.append(_line(name, [(at_s, v / highest_ms * 0.95) for at_s, v in steps], end_s, below))
    parts += _time_axis(below + _PANEL_HEIGHT, end_s)
    return "\n".join([*parts, "</svg>\n"])


def _ways(profile: Profile) -> tuple[tuple[str, DirectionProfile], ...]:
    return ("down", profile.down), ("up", profile.up)


def _length_s(direction: DirectionProfile) -> float:
    return sum(band.duration_ns for band in direction.bands) / 1e9


def _rate_bps(direction: DirectionProfile, index: int) -> float:
    band = direction.bands[index]
    return _DARK if band.rate_bps == 0 or band.loss_ratio == 1.0 else float(band.rate_bps)


def _delay_ms(direction: DirectionProfile, index: int) -> float:
    return direction.bands[index].one_way_delay_ns / 1e6


def _steps(
    direction: DirectionProfile, end_s: float, value: Callable[[DirectionProfile, int], float]
) -> list[tuple[float, float]]:
    """(from when, how much) for each band until end_s."""
    steps, at_s, index = [], 0.0, 0
    while at_s < end_s and index < 10_000:
        steps.append((at_s, value(direction, index % len(direction.bands))))
        at_s += direction.bands[index % len(direction.bands)].duration_ns / 1e9
        index += 1
        if index == len(direction.bands) and not direction.cyclic:
            break
    return steps


def _line(name: str, heights: list[tuple[float, float]], end_s: float, top: float) -> str:
    """A step line; the two directions are shifted by a pixel so that both show where they agree."""
    shift = 0 if name == "down" else 2
    points = []
    for (at_s, height), (next_s, _) in zip(heights, [*heights[1:], (end_s, 0.0)], strict=True):
        y = top + _PANEL_HEIGHT * (1 - height) + shift
        points += [f"{_x(at_s, end_s):.1f},{y:.1f}", f"{_x(min(next_s, end_s), end_s):.1f},{y:.1f}"]
    colour = _COLOURS[name]
    return f'<polyline fill="none" stroke="{colour}" stroke-width="1.8" points="{" ".join(points)}"/>'


def _panel(top: float, title: str, ticks: dict[str, float]) -> list[str]:
    right = _WIDTH - 20
    parts = [f'<text x="{_LEFT}" y="{top - 6}" fill="#333">{title}</text>']
    for label, height in ticks.items():
        y = top + _PANEL_HEIGHT * (1 - height)
        parts.append(f'<line x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end" fill="#555">{label}</text>')
    return parts


def _time_axis(bottom: float, end_s: float) -> list[str]:
    parts = []
    for k in range(7):
        at_s = end_s * k / 6
        x = _x(at_s, end_s)
        parts.append(
            f'<text x="{x:.1f}" y="{bottom + 18}" text-anchor="middle" fill="#555">{at_s:g} s</text>'
        )
    for k, (name, colour) in enumerate(_COLOURS.items()):
        x = _LEFT + 110 * k
        parts.append(f'<text x="{x}" y="{bottom + 44}" fill="{colour}">&#9473; {name}</text>')
    return parts


def _x(at_s: float, end_s: float) -> float:
    return _LEFT + (_WIDTH - 20 - _LEFT) * at_s / end_s


def _rate_name(rate_bps: float) -> str:
    for unit, name in ((1e9, "Gbit/s"), (1e6, "Mbit/s"), (1e3, "kbit/s")):
        if rate_bps >= unit:
            return f"{rate_bps / unit:g} {name}"
    return f"{rate_bps:g} bit/s"
