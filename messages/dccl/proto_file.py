"""Load users' own .proto files at run time, into a descriptor pool of their own.

DCCL's options are found under the paths that DCCL's users import. Needs the extra `proto` (grpcio-tools,
which brings protoc).
"""

from __future__ import annotations

import importlib.util
import subprocess  # noqa: TID251 - protoc is a process; it runs once, when a schema is loaded
import sys
import tempfile
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor import Descriptor
from google.protobuf.message import Message as ProtobufMessage

from messages.dccl.errors import SchemaError
from messages.dccl.options import as_descriptor, message_options

MessageTypes = dict[str, type[ProtobufMessage]]


def load_proto(path: Path | str, folders: Sequence[Path | str] = ()) -> MessageTypes:
    """The message classes of a .proto file by full name, nested ones included, in order of declaration.

    folders: where its imports are looked up, beside its own folder and that of DCCL's options.
    SchemaError: protoc's own words where the file does not compile.
    """
    path = Path(path).resolve()
    if not path.is_file():
        raise SchemaError(f"{path}: no such .proto file")
    descriptors = _compile(path, [Path(folder).resolve() for folder in folders])
    pool = descriptor_pool.DescriptorPool()
    for file in descriptors.file:
        pool.Add(file)
    types: MessageTypes = {}
    for message in pool.FindFileByName(descriptors.file[-1].name).message_types_by_name.values():
        _add(message, types)
    return types


def sendable_types(types: MessageTypes) -> MessageTypes:
    """Those of the types that are to be sent by themselves: they state a (dccl.msg).max_bytes."""
    return {n: t for n, t in types.items() if message_options(as_descriptor(t)).max_bytes is not None}


def _add(message: Descriptor, types: MessageTypes) -> None:
    if message.GetOptions().map_entry:
        return
    types[message.full_name] = message_factory.GetMessageClass(message)
    for nested in message.nested_types:
        _add(nested, types)


def _compile(path: Path, folders: Sequence[Path]) -> descriptor_pb2.FileDescriptorSet:
    if importlib.util.find_spec("grpc_tools") is None:
        raise SchemaError(
            f"{path}: compiling a .proto needs protoc: install straitlink[proto] (grpcio-tools)"
        )
    ours = Path(str(files("messages") / "proto"))
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "descriptors"
        search = [*folders, path.parent, ours, ours.parent.parent, Path(str(files("grpc_tools") / "_proto"))]
        arguments = [
            *(f"--proto_path={place}" for place in search),
            "--include_imports",
            f"--descriptor_set_out={output}",
            str(path),
        ]
        run = subprocess.run(
            [sys.executable, "-m", "grpc_tools.protoc", *arguments],
            capture_output=True,
            text=True,
            check=False,
        )
        if run.returncode != 0:
            raise SchemaError(f"{path} does not compile:\n{run.stderr.strip()}")
        return descriptor_pb2.FileDescriptorSet.FromString(output.read_bytes())
