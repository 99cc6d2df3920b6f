"""straitlink.1: codecs beyond DCCL, for fields and messages that ask for them by name. See docs/dccl.md."""
