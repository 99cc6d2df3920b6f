"""The estimator's states and all that moves it between them; the docs' diagram is drawn from this table."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """What the sender believes of the link."""

    PROBE = "probe"
    """The rate is not known, or no longer: short trains are sent to measure it."""
    RUN = "run"
    """Rate and delay are known: departures follow the virtual queue."""
    HOLD = "hold"
    """Nothing is heard, or nothing arrives: only a trickle leaves."""


class Input(StrEnum):
    """What happens."""

    MEASURED = "trains tell the rate"
    UNCHANGED = "a packet met what the old band predicts"
    SILENCE = "the peer's promise ran out"
    QUICKENED = "the way back is suddenly shorter"
    FILLS = "the way back runs full"
    OVERDUE = "a packet should have been reported"
    HEARD = "the peer is heard again"
    HICCUP = "what broke the silence was not late"
    FALL = "packets are spread by more than the rate explains"
    RISE = "packets are spread by less"


TRANSITIONS: dict[tuple[State, Input], State] = {
    (State.PROBE, Input.MEASURED): State.RUN,
    (State.PROBE, Input.UNCHANGED): State.RUN,
    (State.PROBE, Input.SILENCE): State.HOLD,
    (State.PROBE, Input.FILLS): State.HOLD,
    (State.RUN, Input.FALL): State.RUN,
    (State.RUN, Input.RISE): State.RUN,
    (State.RUN, Input.SILENCE): State.HOLD,
    (State.RUN, Input.QUICKENED): State.HOLD,
    (State.RUN, Input.FILLS): State.HOLD,
    (State.RUN, Input.OVERDUE): State.HOLD,
    (State.HOLD, Input.HEARD): State.PROBE,
    (State.HOLD, Input.HICCUP): State.RUN,
    (State.HOLD, Input.UNCHANGED): State.RUN,
    (State.HOLD, Input.MEASURED): State.RUN,
}
"""What is not named here changes nothing."""


def follow(state: State, happened: Input) -> State:
    """The state after an input."""
    return TRANSITIONS.get((state, happened), state)


def mermaid() -> str:
    """The table as a Mermaid diagram, for the docs."""
    lines = ["stateDiagram-v2", "    [*] --> probe"]
    for (state, happened), after in TRANSITIONS.items():
        lines.append(f"    {state.value} --> {after.value}: {happened.value}")
    return "\n".join(lines)
