"""Which exceptions are the user's to read: one line and exit code 2, no traceback."""

from __future__ import annotations


def user_errors() -> tuple[type[BaseException], ...]:
    """The base classes of the packages' own errors, imported only when one has been raised."""
    from netem_scripts.band import ProfileError
    from netem_scripts.udp_proxy import ProxyError
    from shaper.bus import BusError
    from shaper.errors import ShaperError
    from shaper.udp import UdpError

    return (ShaperError, BusError, UdpError, ProfileError, ProxyError)
