"""Addresses as they stand in a configuration."""

from __future__ import annotations

from ipaddress import ip_address


def parse_address(text: str) -> tuple[str, int]:
    """ "host:port" as (host, port). Raises ValueError with what was expected."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not (port.isascii() and port.isdigit()) or not 0 < int(port) < 65_536:
        raise ValueError(
            f"expected host:port with a port of 1 to 65535, such as 127.0.0.1:9001, not {text!r}"
        )
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Whether an address never leaves this host."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
