"""Regenerate messages/proto/**/*_pb2.py and .pyi from the .proto files beside them.

    python tools/generate_protobuf.py [OUTPUT_FOLDER]

Paths are relative to the repository's root, so that a module's name is its path:
`messages.proto.straitlink.heartbeat_pb2`. DCCL's options are the exception: users' .proto files import
them as `dccl/option_extensions.proto`, and a descriptor pool that met the same options under two names
would refuse the second. Needs the extra `dev` (grpcio-tools, mypy-protobuf).
"""

from __future__ import annotations

import os
import sys
from importlib.resources import files
from pathlib import Path

from grpc_tools import protoc

ROOT = Path(__file__).resolve().parent.parent
PROTO = ROOT / "messages" / "proto"


def proto_files() -> list[Path]:
    """The .proto files, relative to the repository's root, in a stable order."""
    return sorted(path.relative_to(ROOT) for path in (ROOT / "messages" / "proto").rglob("*.proto"))


def generate(output: Path) -> None:
    """Write the modules and stubs of every .proto file below `output`; raise RuntimeError on an error."""
    # protoc finds protoc-gen-mypy on the PATH; it lives beside the interpreter that runs us.
    beside_python = str(Path(sys.executable).parent)
    os.environ["PATH"] = os.pathsep.join([beside_python, os.environ.get("PATH", "")])
    dccl_folder = (PROTO / "dccl").relative_to(ROOT)
    ours = [path for path in proto_files() if not path.is_relative_to(dccl_folder)]
    dccl = [path for path in proto_files() if path.is_relative_to(dccl_folder)]
    _run_protoc([ROOT, PROTO], ours, output)
    _run_protoc([PROTO], [(ROOT / path).relative_to(PROTO) for path in dccl], output / "messages" / "proto")
    for module in (output / "messages" / "proto").rglob("*_pb2.py*"):
        _import_dccl_from_its_package(module)


def _run_protoc(folders: list[Path], proto_files: list[Path], output: Path) -> None:
    output.mkdir(parents=True, exist_ok=True)
    arguments = [
        "protoc",
        *(f"--proto_path={folder}" for folder in folders),
        f"--proto_path={files('grpc_tools') / '_proto'}",
        f"--python_out={output}",
        f"--mypy_out={output}",
        *(str(path) for path in proto_files),
    ]
    previous = Path.cwd()
    os.chdir(folders[0])
    try:
        status = protoc.main(arguments)
    finally:
        os.chdir(previous)
    if status != 0:
        raise RuntimeError(f"protoc ended with status {status}; its messages are above")


def _import_dccl_from_its_package(module: Path) -> None:
    text = module.read_text()
    changed = text.replace("\nfrom dccl import ", "\nfrom messages.proto.dccl import ").replace(
        "\nfrom dccl.", "\nfrom messages.proto.dccl."
    )
    if changed != text:
        module.write_text(changed)


if __name__ == "__main__":
    generate(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT)
