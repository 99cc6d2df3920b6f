"""All parts of the page, each made from the JSON that its bench leaves under out/bench."""

from __future__ import annotations

from collections.abc import Callable

from bench.page.cost import ingest, live_mission, mission, scale, soak
from bench.page.link import calibration, link_estimation, live_link, trials_rule
from bench.page.messages import codec, delta, encodings
from bench.page.peers import peers
from bench.page.provenance import Document
from bench.page.section import Section
from bench.page.views import perception, perception_accuracy, perception_chain, view_codec, view_fuzz
from bench.page.wire import wire_flood, wire_kill

SECTIONS: dict[str, Callable[[Document], Section]] = {
    "peers": peers,
    "trials_rule": trials_rule,
    "link_estimation": link_estimation,
    "live_link": live_link,
    "mission": mission,
    "live_mission": live_mission,
    "wire_kill": wire_kill,
    "wire_flood": wire_flood,
    "wire_flood_initiations": wire_flood,
    "ingest": ingest,
    "scale": scale,
    "soak": soak,
    "view_codec": view_codec,
    "perception": perception,
    "perception_accuracy": perception_accuracy,
    "perception_chain": perception_chain,
    "view_fuzz": view_fuzz,
    "codec": codec,
    "encodings": encodings,
    "delta": delta,
    "calibration": calibration,
}
"""By the name of the JSON file, in the order of the page."""
