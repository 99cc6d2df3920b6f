"""A JPEG's numbers as decisions: zero or not, size in ones up to LONGEST_RUN, the rest in gamma, sign."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .compiled import Ints, compiled, ints
from .mixer import Mixer, code_decision, fresh_mixer

INPUTS = 6
VALUE_SETS = 5  # sets of weights for a number: zero or not, above 1, above 2, above more, sign
LONGEST_RUN = 14
_GAMMA_BITS = 12  # above all differences of two DCs
_SLOT_BITS = 14
_KINDS = 32  # of decisions that share contexts: the first are ones of a run
_GAMMA_KIND, _GAMMA_REST_KIND, _SIGN_KIND = LONGEST_RUN + 1, 28, 31
COUNT_KINDS = (29, 30)


class Model(NamedTuple):
    """A mixer, and the contexts of what comes next."""

    mixer: Mixer
    contexts: Ints  # of the size of a number, or of a count
    signs: Ints  # of the sign of a number


def fresh_model(coder: Ints, data: NDArray[np.uint8], sets: int) -> Model:
    """A model that has seen nothing, with `sets` sets of weights."""
    mixer = fresh_mixer(coder, data, INPUTS, sets, _SLOT_BITS)
    return Model(mixer, ints([0] * INPUTS), ints([0] * INPUTS))


@compiled
def _code(model: Model, bit: int, contexts: Ints, kind: int, weights_set: int) -> int:
    """Write or read a decision of one kind."""
    for i in range(INPUTS):
        model.mixer.contexts[i] = contexts[i] * _KINDS + kind
    return code_decision(model.mixer, bit, model.mixer.contexts, weights_set)


@compiled
def code_number(model: Model, number: int, not_zero: bool, weights_set: int) -> int:
    """Write or read a number in the model's contexts; `not_zero`: that is known to both sides."""
    size = abs(number)
    if not not_zero and not _code(model, 1 if size else 0, model.contexts, 0, weights_set):
        return 0
    known = 1
    while known < LONGEST_RUN:
        more = 1 if size > known else 0
        if not _code(model, more, model.contexts, known, weights_set + min(known, 3)):
            break
        known += 1
    if known == LONGEST_RUN:
        known += _code_gamma(model, size - LONGEST_RUN, weights_set + 3)
    negative = _code(model, 1 if number < 0 else 0, model.signs, _SIGN_KIND, weights_set + 4)
    return -known if negative else known


@compiled
def _code_gamma(model: Model, rest: int, weights_set: int) -> int:
    """A number from 0: how many bits rest + 1 has, then those behind its first."""
    bits = 0
    while bits < _GAMMA_BITS - 1:
        more = 1 if (rest + 1) >> (bits + 1) else 0
        if not _code(model, more, model.contexts, _GAMMA_KIND + bits, weights_set):
            break
        bits += 1
    coded = 1
    for shift in range(bits - 1, -1, -1):
        bit = ((rest + 1) >> shift) & 1
        coded = coded << 1 | _code(model, bit, model.contexts, _GAMMA_REST_KIND, weights_set)
    return coded - 1


@compiled
def code_count(model: Model, count: int, bits: int, kind: int, weights_set: int) -> int:
    """Write or read a count of `bits` bits, highest first, in the model's contexts and the bits so far."""
    coded = 1
    for shift in range(bits - 1, -1, -1):
        for i in range(INPUTS):
            model.signs[i] = model.contexts[i] << bits | coded
        coded = coded << 1 | _code(model, (count >> shift) & 1, model.signs, kind, weights_set + shift)
    return coded - (1 << bits)
