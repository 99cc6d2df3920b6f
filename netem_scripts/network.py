"""Addresses and devices of the two sides, and the two kernel structures that ifconfig would fill in."""

from __future__ import annotations

import ctypes
import struct
from ipaddress import IPv4Address

ROBOT_ADDRESS = "10.71.0.1"
OPERATOR_ADDRESS = "10.71.0.2"
NETMASK, NETMASK_BITS = "255.255.255.252", 30
DEVICE = "link0"
DEVICE_MTU_BYTES = 1500

_AF_INET = 2


def interface_request(device: str, address: str) -> bytes:
    """struct ifreq with an IPv4 address (netdevice(7))."""
    return struct.pack("16s16s8x", device.encode(), _socket_address(address))


def default_route(device: str) -> tuple[bytes, object]:
    """struct rtentry of a default route without gateway (Linux, route.h), and the memory it points to."""
    name = ctypes.create_string_buffer(device.encode())
    any_address, up = _socket_address("0.0.0.0"), 1
    entry = struct.pack(
        "L16s16s16sHhLPhPLLH", 0, any_address, any_address, any_address, up, 0, 0, 0, 0,
        ctypes.addressof(name), 0, 0, 0,
    )  # fmt: skip
    return entry, name


def _socket_address(address: str) -> bytes:
    return struct.pack("=HH4s8x", _AF_INET, 0, IPv4Address(address).packed)
