"""The seed corpus of the fuzzer, and what it once found, pass every parser of the network."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import given
from hypothesis import strategies as st

ROOT = Path(__file__).resolve().parents[2]


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_wire", ROOT / "tools" / "fuzz_wire.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz_wire"] = module
    spec.loader.exec_module(module)
    return module


FUZZ = load()


@pytest.mark.parametrize("name", FUZZ.TARGETS)
def test_the_corpus_of_each_parser_passes(name: str) -> None:
    inputs = sorted((FUZZ.CORPUS / name).iterdir())
    assert inputs
    for path in inputs:
        FUZZ.run_target(name, path.read_bytes())


@pytest.mark.parametrize("name", FUZZ.TARGETS)
@given(st.binary(max_size=300))
def test_any_bytes_pass(name: str, data: bytes) -> None:
    FUZZ.run_target(name, data)


def test_the_seeds_are_those_of_the_present_wire() -> None:
    for name, inputs in FUZZ.seeds().items():
        for index, data in enumerate(inputs):
            assert (FUZZ.CORPUS / name / f"{index:02}").read_bytes() == data, "run tools/fuzz_wire.py --seeds"
