from hypothesis import given
from hypothesis import strategies as st

from shaper.serial_number import ReceivedWindow, expand, expand_above


@given(
    bits=st.sampled_from([16, 24, 32]),
    near=st.integers(0, 1 << 50),
    distance=st.integers(-(1 << 31), (1 << 31) - 1),
)
def test_a_number_within_half_the_range_is_found_again(bits: int, near: int, distance: int) -> None:
    half = 1 << (bits - 1)
    number = near + max(-half, min(half - 1, distance))

    assert expand(number & ((1 << bits) - 1), bits, near) == number


def test_numbers_expand_across_the_wrap_in_both_directions() -> None:
    assert expand(0x0002, 16, near=0xFFFE) == 0x1_0002
    assert expand(0xFFFE, 16, near=0x1_0002) == 0xFFFE
    assert expand(0xFFFFFF, 24, near=0) == -1


@given(bits=st.sampled_from([16, 24]), floor=st.integers(-300, 1 << 40), ahead=st.integers(1, 1 << 16))
def test_a_number_within_the_whole_range_above_a_floor_is_found_again(
    bits: int, floor: int, ahead: int
) -> None:
    assert expand_above((floor + ahead) & ((1 << bits) - 1), bits, floor) == floor + ahead


@given(st.lists(st.integers(0, 60), max_size=80), st.integers(1, 24))
def test_the_window_agrees_with_a_set(numbers: list[int], span: int) -> None:
    window = ReceivedWindow(span)
    seen: set[int] = set()
    for number in numbers:
        too_old = bool(seen) and number <= max(seen) - span
        assert window.accept(number) == (number not in seen and not too_old)
        seen.add(number)  # too old or known already: the highest stays the same either way
        assert window.highest == max(seen)


def test_the_window_holds_a_bounded_number_of_bits_after_any_jump() -> None:
    window = ReceivedWindow(span=64)
    for number in (0, 1, 1 << 40, (1 << 40) + 63, (1 << 40) + 64):
        assert window.accept(number)
    assert window._seen < 1 << 64
    assert not window.accept(1 << 40)
