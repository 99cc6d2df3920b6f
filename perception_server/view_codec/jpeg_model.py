"""What the decisions about a JPEG's coefficients share: contexts to probabilities, numbers to decisions.

Each decision has INPUTS contexts, numbers of up to 20 bits that say what is known about it; each leads
to a slot of its own table, by a hash that both sides compute. Numbers are coded as zero or not, size in
ones up to LONGEST_RUN, the rest in Elias gamma, sign.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .binary_coder import code_bit
from .compiled import Ints, compiled, ints
from .context_mixing import (
    FRESH,
    MIXER_ONE,
    NAT,
    RATE,
    SQUASH,
    STRETCH,
    learned,
    logit_of,
    mixed,
    squash,
    train,
)

INPUTS = 6
WEIGHTS = INPUTS + 1  # of a set: the last is for a constant
VALUE_SETS = 5  # sets of weights for a number: zero or not, above 1, above 2, above more, sign
MOST_DECISIONS = 4_000_000  # of a message: half a second, and 50 times what 512x272 pixels take
LONGEST_RUN = 14
MOST_SIZE = LONGEST_RUN - 1 + (1 << 12) - 1  # above all differences of two DCs
_GAMMA_BITS = 12
_SLOTS = 1 << 14  # of each input
_LIMIT = 250  # a slot's memory, in decisions
_TRAINING_SHIFT = 15
_LEAST_P = 32  # in 1/65536
_HASH = 2_654_435_761  # Knuth's multiplicative hash
_HASH_SHIFT = 13
_KINDS = 32  # of decisions that share contexts: the first are ones of a run
_GAMMA_KIND, _GAMMA_REST_KIND, _SIGN_KIND = LONGEST_RUN + 1, 28, 31
COUNT_KINDS = (29, 30)


class Model(NamedTuple):
    """Everything that adapts, the coder, and the tables; flat sequences of whole numbers."""

    coder: Ints
    data: NDArray[np.uint8]
    stretch: Ints
    squash: Ints
    rates: Ints
    slots: Ints
    weights: Ints
    inputs: Ints
    at: Ints
    contexts: Ints  # of the size of a number, or of a count
    signs: Ints  # contexts of the sign of a number
    decisions: Ints  # how many there were


def fresh_model(coder: Ints, data: NDArray[np.uint8], sets: int) -> Model:
    """A model that has seen nothing, with `sets` sets of weights."""
    weights = np.zeros((sets, WEIGHTS), np.int64)
    weights[:, :INPUTS] = MIXER_ONE * 5 // 16
    return Model(
        coder,
        data,
        STRETCH,
        SQUASH,
        RATE,
        ints(np.full(INPUTS * _SLOTS, FRESH)),
        ints(weights),
        ints([NAT] * WEIGHTS),
        ints([0] * INPUTS),
        ints([0] * INPUTS),
        ints([0] * INPUTS),
        ints([0]),
    )


@compiled
def code_decision(model: Model, bit: int, contexts: Ints, kind: int, weights_at: int) -> int:
    """Write or read one decision in its contexts."""
    for i in range(INPUTS):
        mark = (contexts[i] * _KINDS + kind) * INPUTS + i
        model.at[i] = i * _SLOTS + ((mark * _HASH >> _HASH_SHIFT) & (_SLOTS - 1))
        model.inputs[i] = logit_of(model.stretch, model.slots[model.at[i]])
    p = squash(model.squash, mixed(model.weights, weights_at, model.inputs, WEIGHTS))
    p = min(max(p, _LEAST_P), 65536 - _LEAST_P)
    bit = code_bit(model.coder, model.data, bit, p)
    train(model.weights, weights_at, model.inputs, WEIGHTS, (bit << 16) - p, _TRAINING_SHIFT)
    for i in range(INPUTS):
        model.slots[model.at[i]] = learned(model.rates, model.slots[model.at[i]], bit, _LIMIT)
    model.decisions[0] += 1
    return bit


@compiled
def code_number(model: Model, number: int, not_zero: bool, weights_set: int) -> int:
    """Write or read a number of at most MOST_SIZE, in the model's contexts; `not_zero`: both sides know."""
    size = abs(number)
    first = WEIGHTS * weights_set
    if not not_zero and not code_decision(model, 1 if size else 0, model.contexts, 0, first):
        return 0
    known = 1
    while known < LONGEST_RUN:
        weights_at = first + WEIGHTS * min(known, 3)
        if not code_decision(model, 1 if size > known else 0, model.contexts, known, weights_at):
            break
        known += 1
    if known == LONGEST_RUN:
        known += _code_gamma(model, size - LONGEST_RUN, first + WEIGHTS * 3)
    negative = code_decision(model, 1 if number < 0 else 0, model.signs, _SIGN_KIND, first + WEIGHTS * 4)
    return -known if negative else known


@compiled
def _code_gamma(model: Model, rest: int, weights_at: int) -> int:
    """A number from 0: how many bits rest + 1 has, then those behind its first."""
    bits = 0
    while bits < _GAMMA_BITS - 1:
        more = 1 if (rest + 1) >> (bits + 1) else 0
        if not code_decision(model, more, model.contexts, _GAMMA_KIND + bits, weights_at):
            break
        bits += 1
    coded = 1
    for shift in range(bits - 1, -1, -1):
        bit = ((rest + 1) >> shift) & 1
        coded = coded << 1 | code_decision(model, bit, model.contexts, _GAMMA_REST_KIND, weights_at)
    return coded - 1


@compiled
def code_count(model: Model, count: int, bits: int, kind: int, weights_set: int) -> int:
    """Write or read a count of `bits` bits, highest first, in the model's contexts and the bits so far."""
    coded = 1
    for shift in range(bits - 1, -1, -1):
        for i in range(INPUTS):
            model.signs[i] = model.contexts[i] << bits | coded
        weights_at = WEIGHTS * (weights_set + shift)
        coded = coded << 1 | code_decision(model, (count >> shift) & 1, model.signs, kind, weights_at)
    return coded - (1 << bits)


@compiled
def rough(size: int) -> int:
    """A size from 0 on a scale of two steps to each doubling: 0, 1, 2, 3, 4 (4..5), 5 (6..7), 6 (8..11)."""
    if size < 4:
        return size
    bits = 2
    while size >> (bits + 1):
        bits += 1
    return 2 * bits + ((size >> (bits - 1)) & 1)
