"""Regenerate messages/proto/**/*_pb2.py and .pyi from the .proto files beside them.

    python tools/generate_protobuf.py [OUTPUT_FOLDER]

Paths are relative to the repository's root, so that a module's name is its path:
`messages.proto.straitlink.heartbeat_pb2`. Needs the extra `dev` (grpcio-tools, mypy-protobuf).
"""

from __future__ import annotations

import os
import sys
from importlib.resources import files
from pathlib import Path

from grpc_tools import protoc

ROOT = Path(__file__).resolve().parent.parent


def proto_files() -> list[Path]:
    """The .proto files, relative to the repository's root, in a stable order."""
    return sorted(path.relative_to(ROOT) for path in (ROOT / "messages" / "proto").rglob("*.proto"))


def generate(output: Path) -> None:
    """Write the modules and stubs of every .proto file below `output`; raise RuntimeError on an error."""
    # protoc finds protoc-gen-mypy on the PATH; it lives beside the interpreter that runs us.
    beside_python = str(Path(sys.executable).parent)
    os.environ["PATH"] = os.pathsep.join([beside_python, os.environ.get("PATH", "")])
    arguments = [
        "protoc",
        f"--proto_path={ROOT}",
        f"--proto_path={files('grpc_tools') / '_proto'}",
        f"--python_out={output}",
        f"--mypy_out={output}",
        *(str(path) for path in proto_files()),
    ]
    previous = Path.cwd()
    os.chdir(ROOT)
    try:
        status = protoc.main(arguments)
    finally:
        os.chdir(previous)
    if status != 0:
        raise RuntimeError(f"protoc ended with status {status}; its messages are above")


if __name__ == "__main__":
    generate(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT)
