"""Paths under which older .proto files import the options of DCCL."""
