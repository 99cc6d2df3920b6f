"""Which exceptions are the user's to read: one line, no traceback."""

from __future__ import annotations


def user_errors() -> tuple[type[Exception], ...]:
    """The base classes of the packages' own errors; imported only when something was raised."""
    from messages.dccl import DcclError
    from messages.payload import PayloadError
    from messages.urdf import UrdfError
    from netem_scripts.band import ProfileError
    from netem_scripts.udp_proxy import ProxyError
    from perception_server.errors import PerceptionError
    from perception_server.view_codec import ViewCodecError
    from shaper.bus import BusError
    from shaper.errors import ShaperError
    from shaper.metrics import MetricsError
    from shaper.udp import UdpError
    from straitlink.demo.errors import DemoError
    from straitlink.record import RecordError
    from straitlink.replay import ReplayError
    from straitlink.report import ReportError
    from straitlink.request_client import RequestFailedError

    return (
        ShaperError,
        DcclError,
        PayloadError,
        UrdfError,
        BusError,
        UdpError,
        MetricsError,
        ProfileError,
        ProxyError,
        PerceptionError,
        ViewCodecError,
        DemoError,
        ReplayError,
        RecordError,
        ReportError,
        RequestFailedError,
    )
