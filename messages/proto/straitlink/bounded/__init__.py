"""Our own messages, for what no Foxglove schema describes. Generated: see tools/generate_protobuf.py."""
