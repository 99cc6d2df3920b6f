"""One decision in several contexts: what each context has seen, mixed, coded, and learned from.

A context is a number of up to 25 bits that says what is known about the decision. Each input has a table
of its own, in which a context leads to a slot by a hash; contexts that fall together share it, in both
coders alike.
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

_FIRST_WEIGHTS = 2 * MIXER_ONE - MIXER_ONE // 8  # their sum, over the inputs: contexts add to each other
_TRAINING_SHIFT = 15
_MEMORY = 250  # of a slot, in decisions
_LEAST_P = 32  # in 1/65536
_HASH = 2_654_435_761  # Knuth's multiplicative hash
_HASH_SHIFT = 13


class Mixer(NamedTuple):
    """Everything that adapts, the coder, and the tables; flat sequences of whole numbers."""

    coder: Ints
    data: NDArray[np.uint8]
    stretch: Ints
    squash: Ints
    rates: Ints
    slots: Ints
    weights: Ints
    inputs: Ints  # logits, and behind them a constant
    at: Ints  # the slot of each input
    contexts: Ints
    decisions: Ints  # how many there were


def fresh_mixer(coder: Ints, data: NDArray[np.uint8], inputs: int, sets: int, slot_bits: int) -> Mixer:
    """A mixer that has seen nothing: `sets` sets of weights, 2**slot_bits slots for each input."""
    weights = np.zeros((sets, inputs + 1), np.int64)
    weights[:, :inputs] = _FIRST_WEIGHTS // inputs
    return Mixer(
        coder,
        data,
        STRETCH,
        SQUASH,
        RATE,
        ints(np.full(inputs << slot_bits, FRESH)),
        ints(weights),
        ints([NAT] * (inputs + 1)),
        ints([0] * inputs),
        ints([0] * inputs),
        ints([0]),
    )


@compiled
def code_decision(mixer: Mixer, bit: int, contexts: Ints, weights_set: int) -> int:
    """Write or read one decision in its contexts, with a set of weights."""
    count = len(mixer.at)
    room = len(mixer.slots) // count
    at, inputs, slots = mixer.at, mixer.inputs, mixer.slots
    for i in range(count):
        at[i] = i * room + (((contexts[i] * count + i) * _HASH >> _HASH_SHIFT) & (room - 1))
        inputs[i] = logit_of(mixer.stretch, slots[at[i]])
    weights_at = weights_set * (count + 1)
    p = squash(mixer.squash, mixed(mixer.weights, weights_at, inputs, count + 1))
    p = min(max(p, _LEAST_P), 65536 - _LEAST_P)
    bit = code_bit(mixer.coder, mixer.data, bit, p)
    train(mixer.weights, weights_at, inputs, count + 1, (bit << 16) - p, _TRAINING_SHIFT)
    for i in range(count):
        slots[at[i]] = learned(mixer.rates, slots[at[i]], bit, _MEMORY)
    mixer.decisions[0] += 1
    return bit


@compiled
def rough(size: int) -> int:
    """A size from 0 on a scale of two steps to each doubling: 0, 1, 2, 3, 4 (4..5), 5 (6..7), 6 (8..11)."""
    if size < 4:
        return size
    bits = 2
    while size >> (bits + 1):
        bits += 1
    return 2 * bits + ((size >> (bits - 1)) & 1)
