"""What can go wrong in the demonstration."""

from __future__ import annotations


class DemoError(Exception):
    """The demonstration cannot start or go on; the message says which part and why."""
