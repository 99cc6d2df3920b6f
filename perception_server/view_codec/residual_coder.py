"""A cell's code, as binary decisions about its distance from the guess.

Zero or not; above or below; whether the distance reaches 2, 4, 8, ...; then its lower bits. Each decision
mixes what every expert's logistic distribution says of it with what a few contexts have seen of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .binary_coder import code_bit
from .cell_experts import EXPERTS, Guesses
from .compiled import Doubles, Ints, compiled, doubles, inlined, ints
from .context_mixing import (
    FRESH,
    MIXER_ONE,
    NAT,
    Tables,
    confident_logit,
    learned,
    mixed,
    squash,
    train,
)

CONTEXTS = 7
CONTEXT_VALUES = 512  # each context's range
SPREADS = 10  # classes of expected error, which choose mixing weights
ZERO, SIGN, REACH, LOW_BITS, DEEP_BITS = 0, 1, 2, 19, 53  # decisions: one, one, 17, 2 x 17, 5
DECISIONS = 58
_INPUTS = EXPERTS + CONTEXTS + 1
_MIXER_SHIFT = 18
_LIMIT = 60  # decisions after which a context's mean begins to forget
_FIRST_EXPERT = MIXER_ONE * 12 // 100
_FIRST_CONTEXT = MIXER_ONE * 8 // 100
_LEAST_SCALE = 0.2
_SCALE = 0.5  # of a logistic distribution to its recent mean error
_FLOOR = 1e-5  # of a probability, so that far tails say nothing rather than anything
_TAIL_STEPS = 16  # to one scale
_TAIL_END = 20 * _TAIL_STEPS


def _tail_table() -> Doubles:
    """1 / (1 + exp(i / 16)) for i = 0..321, each the nearest double, by whole-number powers."""
    one = 1 << 128
    root, term, divisor = one, one, 0
    while term:
        divisor += 1
        term = term // _TAIL_STEPS // divisor
        root += term
    power, tail = one, []
    for _ in range(_TAIL_END + 2):
        tail.append(one / (one + power))
        power = power * root >> 128
    return doubles(tail)


class ResidualModel(NamedTuple):
    """What is learnt of one map's residuals, and the sharpened guesses at the present cell."""

    tail: Doubles
    slots: Ints
    kind_weights: Ints  # mixing weights by decision
    spread_weights: Ints  # mixing weights by decision and expected error
    contexts: Ints  # CONTEXTS values below CONTEXT_VALUES, set by the caller for each cell
    slot_of: Ints  # each context's slot for the present decision
    kind_uses: Ints  # how often each set of weights was used
    spread_uses: Ints
    inputs: Ints
    offset: Doubles  # of each guess from the whole-number guess
    sharpness: Doubles  # 1 / scale of each guess's distribution
    above: Doubles  # probability that is still possible, from its lower end on
    below: Doubles  # probability beyond its upper end
    beyond: Doubles  # probability beyond the present decision


def fresh_residual_model() -> ResidualModel:
    """A model that has seen nothing."""
    first = np.full(_INPUTS, _FIRST_CONTEXT)
    first[:EXPERTS] = _FIRST_EXPERT
    return ResidualModel(
        tail=_TAIL,
        slots=ints(np.full(CONTEXTS * CONTEXT_VALUES * DECISIONS, FRESH)),
        kind_weights=ints(np.tile(first, DECISIONS)),
        spread_weights=ints(np.tile(first, DECISIONS * SPREADS)),
        contexts=ints(np.zeros(CONTEXTS)),
        slot_of=ints(np.zeros(CONTEXTS)),
        kind_uses=ints(np.zeros(DECISIONS)),
        spread_uses=ints(np.zeros(DECISIONS * SPREADS)),
        inputs=ints(np.zeros(_INPUTS)),
        offset=doubles(np.zeros(EXPERTS)),
        sharpness=doubles(np.zeros(EXPERTS)),
        above=doubles(np.zeros(EXPERTS)),
        below=doubles(np.zeros(EXPERTS)),
        beyond=doubles(np.zeros(EXPERTS)),
    )


_TAIL = _tail_table()


@inlined
def code_residual(
    coder: Ints,
    data: NDArray[np.uint8],
    residual: int,
    tables: Tables,
    model: ResidualModel,
    guesses: Guesses,
    guess: int,
    levels: int,
    spread: int,
) -> int:
    """Write code - guess, or read and return it; guess + result is always within 0..levels - 1."""
    if levels == 1:
        return 0
    for e in range(EXPERTS):
        offset = guesses.at[e] - guess
        sharpness = 1.0 / (guesses.error[e] * _SCALE + _LEAST_SCALE)
        above = _tail(model.tail, (0.5 - offset) * sharpness)
        below = _tail(model.tail, (0.5 + offset) * sharpness)
        model.offset[e], model.sharpness[e] = offset, sharpness
        model.above[e], model.below[e] = above, below
        model.inputs[e] = _logit(tables, 1.0 - above - below, 1.0)
    if _decide(coder, data, 1 if residual == 0 else 0, tables, model, ZERO, spread):
        return 0
    is_above = guess == 0
    if 0 < guess < levels - 1:
        for e in range(EXPERTS):
            model.inputs[e] = _logit(tables, model.above[e], model.above[e] + model.below[e])
        is_above = _decide(coder, data, 1 if residual > 0 else 0, tables, model, SIGN, spread) == 1
    sign = 1 if is_above else -1
    if not is_above:
        for e in range(EXPERTS):
            model.above[e] = model.below[e]
            model.offset[e] = -model.offset[e]
    most = levels - 1 - guess if is_above else guess
    return sign * _code_distance(coder, data, residual * sign, tables, model, most, spread)


@inlined
def _code_distance(
    coder: Ints,
    data: NDArray[np.uint8],
    distance: int,
    tables: Tables,
    model: ResidualModel,
    most: int,
    spread: int,
) -> int:
    """Write a distance of 1..most, or read and return one."""
    low, doublings = 1, 0
    for e in range(EXPERTS):
        model.below[e] = 0.0
    while 2 * low <= most:
        _look_beyond(tables, model, 2 * low)
        reaches = 1 if distance >= 2 * low else 0
        if not _decide(coder, data, reaches, tables, model, REACH + doublings, spread):
            for e in range(EXPERTS):
                model.below[e] = model.beyond[e]
            break
        for e in range(EXPERTS):
            model.above[e] = model.beyond[e]
        low *= 2
        doublings += 1
    half, depth = low >> 1, 0
    while half:
        if low + half <= most:
            _look_beyond(tables, model, low + half)
            kind = LOW_BITS + 2 * doublings + depth if depth < 2 else DEEP_BITS + min(depth - 2, 4)
            bit = _decide(coder, data, 1 if distance >= low + half else 0, tables, model, kind, spread)
            for e in range(EXPERTS):
                if bit:
                    model.above[e] = model.beyond[e]
                else:
                    model.below[e] = model.beyond[e]
            if bit:
                low += half
        half >>= 1
        depth += 1
    return low


@inlined
def _look_beyond(tables: Tables, model: ResidualModel, distance: int) -> None:
    """Each expert's opinion whether the distance is reached, given what is known of it."""
    for e in range(EXPERTS):
        beyond = _tail(model.tail, (distance - 0.5 - model.offset[e]) * model.sharpness[e])
        model.beyond[e] = beyond
        below = model.below[e]
        model.inputs[e] = _logit(tables, beyond - below, model.above[e] - below)


@compiled
def _decide(
    coder: Ints,
    data: NDArray[np.uint8],
    bit: int,
    tables: Tables,
    model: ResidualModel,
    kind: int,
    spread: int,
) -> int:
    """Code one decision at the mixed probability, and learn from it; returns its bit."""
    inputs = model.inputs
    for i in range(CONTEXTS):
        slot = (i * CONTEXT_VALUES + model.contexts[i]) * DECISIONS + kind
        model.slot_of[i] = slot
        inputs[EXPERTS + i] = confident_logit(tables, model.slots[slot])
    inputs[EXPERTS + CONTEXTS] = NAT
    spread_set = kind * SPREADS + spread
    kind_at, spread_at = kind * _INPUTS, spread_set * _INPUTS
    by_kind = mixed(model.kind_weights, kind_at, inputs, _INPUTS)
    by_spread = mixed(model.spread_weights, spread_at, inputs, _INPUTS)
    p = squash(tables.squash, (by_kind + by_spread) >> 1)
    bit = code_bit(coder, data, bit, min(max(p, 1), 65535))
    want = bit << 16
    kind_error = (want - squash(tables.squash, by_kind)) * _eagerness(model.kind_uses, kind)
    spread_error = (want - squash(tables.squash, by_spread)) * _eagerness(model.spread_uses, spread_set)
    train(model.kind_weights, kind_at, inputs, _INPUTS, kind_error, _MIXER_SHIFT)
    train(model.spread_weights, spread_at, inputs, _INPUTS, spread_error, _MIXER_SHIFT)
    for i in range(CONTEXTS):
        slot = model.slot_of[i]
        model.slots[slot] = learned(tables.rate, model.slots[slot], bit, _LIMIT)
    return bit


@inlined
def _eagerness(uses: Ints, weights: int) -> int:
    """How far to follow an error, in sixteenths: 22 for fresh weights, towards 6 after some hundred uses."""
    count = uses[weights]
    uses[weights] = count + 1
    return int(6 + 4096 // (256 + count))


@inlined
def _tail(table: Doubles, scales: float) -> float:
    """The logistic distribution's share beyond a point, `scales` from its middle; between steps a line."""
    steps = (scales if scales >= 0.0 else -scales) * _TAIL_STEPS
    if steps >= _TAIL_END:
        share = table[_TAIL_END]
    else:
        step = int(steps)
        share = table[step] + (table[step + 1] - table[step]) * (steps - step)
    return float(share if scales >= 0.0 else 1.0 - share)


@inlined
def _logit(tables: Tables, part: float, whole: float) -> int:
    """The logit of part / whole."""
    share = (part + _FLOOR) / (whole + 2.0 * _FLOOR)
    return int(tables.stretch[min(max(int(share * 4096.0), 0), 4095)])
