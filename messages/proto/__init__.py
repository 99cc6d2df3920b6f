"""Protobuf schemas: the .proto files and the code that tools/generate_protobuf.py makes of them."""
