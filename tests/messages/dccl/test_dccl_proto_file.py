"""Users' own .proto files load as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from messages.dccl import Codec, SchemaError, load_proto, sendable_types

PROTO = """
syntax = "proto2";
import "%s";
package user;
message Part { required double x = 1 [(dccl.field) = { min: 0 max: 1 precision: 2 }]; }
message Whole {
  option (dccl.msg) = { codec_version: 4 id: 1 max_bytes: 32 unit_system: "si" };
  required Part part = 1;
  optional uint32 class = 2 [(dccl.field) = { min: 0 max: 9 units { derived_dimensions: "length" } }];
}
"""


@pytest.mark.parametrize("path", ["dccl/option_extensions.proto", "dccl/protobuf/option_extensions.proto"])
def test_a_users_file_loads_with_the_import_that_it_has(tmp_path: Path, path: str) -> None:
    pytest.importorskip("grpc_tools")
    (tmp_path / "user.proto").write_text(PROTO % path)
    types = load_proto(tmp_path / "user.proto")
    assert list(types) == ["user.Part", "user.Whole"]
    assert list(sendable_types(types)) == ["user.Whole"]
    whole: Any = types["user.Whole"]
    message = whole(part={"x": 0.25}, **{"class": 3})
    codec = Codec(whole)
    assert codec.decode(codec.encode(message)) == message
    assert codec.info().fields[2].unit == "length"


def test_two_files_may_declare_the_same_names(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    for folder, high in (("a", 9), ("b", 99)):
        (tmp_path / folder).mkdir()
        text = (PROTO % "dccl/option_extensions.proto").replace("max: 9", f"max: {high}")
        (tmp_path / folder / "user.proto").write_text(text)
    sizes = [
        Codec(load_proto(tmp_path / folder / "user.proto")["user.Whole"]).info().fields[2].max_bits
        for folder in "ab"
    ]
    assert sizes == [4, 7]


def test_imports_are_found_in_the_folders_given(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "base.proto").write_text(
        'syntax = "proto2";\nmessage Base { optional bool ok = 1; }\n'
    )
    (tmp_path / "top.proto").write_text(
        'syntax = "proto2";\nimport "base.proto";\nmessage Top { optional Base base = 1; }\n'
    )
    assert list(load_proto(tmp_path / "top.proto", [tmp_path / "lib"])) == ["Top"]
    with pytest.raises(SchemaError, match=r"top\.proto does not compile:\n.*base\.proto"):
        load_proto(tmp_path / "top.proto")


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match=r"none\.proto: no such \.proto file"):
        load_proto(tmp_path / "none.proto")


def test_the_example_of_straitlink_1_in_the_documentation_loads_and_costs_what_it_says(
    tmp_path: Path,
) -> None:
    pytest.importorskip("grpc_tools")
    text = (Path(__file__).resolve().parents[3] / "docs" / "dccl.md").read_text()
    example = text.split("```proto\n")[1].split("```")[0]
    path = tmp_path / "state.proto"
    path.write_text(f'syntax = "proto2";\n{example}')
    codec = Codec(load_proto(path)["State"])
    bits = {row.path: row.max_bits for row in codec.info().fields}
    assert (bits["stamp_us"], bits["turn"], bits["knee"], bits["finger"]) == (16, 36, 12, 60)
    assert "straitlink.adaptive.1" in {row.codec for row in codec.info().fields}
