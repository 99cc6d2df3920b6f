"""The finest view that fits is found in few encodings, also where a faster encoder drafts."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_DOES_NOT_FIT, VIEW_STATUS_REFUSED, View
from perception_server.budget import fit, ladder
from perception_server.view_codec import EncodeError
from perception_server.view_wish import Fidelity

FINEST, WORST = Fidelity(0.03, 0.005), Fidelity(0.12, 0.04)


def encoder(bytes_at_finest: float, tried: list[Fidelity]) -> Callable[[Fidelity], View]:
    """Views whose size halves with each doubling of the error, and quarters with each of the resolution."""

    def encode(fidelity: Fidelity) -> View:
        tried.append(fidelity)
        share = (0.005 / fidelity.max_error_m) * (0.03 / fidelity.resolution) ** 2
        return View(data=bytes(int(bytes_at_finest * share)), max_error_m=fidelity.max_error_m)

    return encode


@given(budget=st.integers(0, 12_000), larger=st.floats(1.0, 1.6))
def test_a_draft_changes_nothing_but_what_is_spent(budget: int, larger: float) -> None:
    alone: list[Fidelity] = []
    drafted: list[Fidelity] = []
    drafts: list[Fidelity] = []
    expected = fit(encoder(10_000, alone), FINEST, WORST, budget, 7)
    draft = encoder(10_000 * larger, drafts)
    assert fit(encoder(10_000, drafted), FINEST, WORST, budget, 7, draft) == expected
    assert len(drafted) <= 4
    assert len(set(drafts)) == len(drafts) <= 2 + len(ladder(FINEST, WORST)).bit_length()


def test_what_no_encoder_makes_small_enough_is_told_with_the_real_ones_size() -> None:
    view = fit(encoder(10_000, []), FINEST, WORST, 50, 7, encoder(14_000, []))
    assert view.status == VIEW_STATUS_DOES_NOT_FIT
    assert view.smallest_bytes == len(encoder(10_000, [])(WORST).SerializeToString())


@pytest.mark.parametrize("drafts", [False, True])
def test_what_no_codec_holds_is_refused_in_its_words(drafts: bool) -> None:
    def encode(fidelity: Fidelity) -> View:
        raise EncodeError("too many cells")

    view = fit(encode, FINEST, WORST, 50, 7, encode if drafts else None)
    assert view.status == VIEW_STATUS_REFUSED
    assert "too many cells" in view.error
