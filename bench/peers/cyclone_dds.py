"""Cyclone DDS, ROS 2's transport: best effort and keep last 1 for streams, reliable for commands.

Configuration: config/cyclonedds.xml (unicast discovery, as for a link without multicast). Annotations are
evaluated here: Cyclone reads the type of Blob from them.
"""

import os
import threading
from dataclasses import dataclass

from bench.peers.transport import CONFIG_FOLDER, Session

os.environ.setdefault("CYCLONEDDS_URI", (CONFIG_FOLDER / "cyclonedds.xml").as_uri())

from cyclonedds.core import Policy, Qos, ReadCondition, SampleState, ViewState, InstanceState, WaitSet  # noqa: I001
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import sequence, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Blob(IdlStruct, typename="straitlink_bench.Blob"):
    """Opaque bytes."""

    payload: sequence[uint8]


class CycloneDds:
    """A writer for each topic of ours, a reader for each of the other side's."""

    def __init__(self, session: Session) -> None:
        self._participant = DomainParticipant(0)
        self._writers: dict[str, DataWriter] = {}
        self._ended = False
        self._topics = []
        readers: dict[str, DataReader] = {}
        for load_topic in session.load.topics:
            traffic_class = load_topic.traffic_class
            if traffic_class is None:
                continue
            reliability = (
                Policy.Reliability.Reliable(duration(seconds=1))
                if traffic_class.reliable
                else Policy.Reliability.BestEffort
            )
            depth = 32 if traffic_class.reliable else 1
            qos = Qos(
                reliability,
                Policy.History.KeepLast(depth),
                Policy.TransportPriority(10 - traffic_class.tier),
            )
            topic = Topic(self._participant, load_topic.key.replace("/", "_"), Blob, qos=qos)
            self._topics.append(topic)
            if load_topic.key in session.keys(ours=True):
                self._writers[load_topic.key] = DataWriter(self._participant, topic, qos=qos)
            else:
                readers[load_topic.key] = DataReader(self._participant, topic, qos=qos)
        self._threads = [
            threading.Thread(target=self._receive, args=(key, reader, session), daemon=True)
            for key, reader in readers.items()
        ]
        for thread in self._threads:
            thread.start()

    def publish(self, key: str, payload: bytes) -> None:
        """write() of the topic's writer."""
        self._writers[key].write(Blob(payload=payload))

    def close(self) -> None:
        """The process ends with it."""
        self._ended = True

    def _receive(self, key: str, reader: DataReader, session: Session) -> None:
        wait_set = WaitSet(self._participant)
        wait_set.attach(ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Alive))
        while not self._ended:
            wait_set.wait(duration(milliseconds=500))
            for sample in reader.take(N=32):
                if isinstance(sample, Blob):
                    session.on_message(key, bytes(sample.payload))


def open_transport(_name: str, session: Session) -> CycloneDds:
    """Both sides alike."""
    return CycloneDds(session)
