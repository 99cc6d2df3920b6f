"""What the robot's sensors saw in the last minutes, ready to be looked at from anywhere.

Scans and clouds are placed into the world frame once, when they and the poses around them are there.
One thread inserts; any thread takes snapshots. Memory is bounded by HistoryLimits, old data is dropped in
order of time, and everything that is not kept is counted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from perception_server.errors import PerceptionError, PoseError
from perception_server.frames import Frames, FrameTree, StampedTransform
from perception_server.pictures import Calibration, CameraFrame, Disparity, PictureRing
from perception_server.point_ring import BlockView, PointRing
from perception_server.scan_geometry import RawCloud, RawScan, ScanPlacement, place_cloud, place_scan

_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class HistoryLimits:
    """What a history may hold; the table [history] of a configuration. The defaults take under 400 MB.

    duration_s: 1..3600, of everything. max_scan_points, max_cloud_points: 13 bytes each.
    max_picture_bytes: of all cameras and disparity images together. max_frames: of the tree of frames.
    pose_wait_s: how long a scan waits for the poses around it. max_waiting: scans and clouds that wait.
    max_pose_gap_s: between two samples of a frame's motion; across a longer gap no pose is made up.
    """

    duration_s: float = 125.0  # 5,000 scans at 40 Hz
    max_scan_points: int = 6_000_000
    max_cloud_points: int = 4_000_000
    max_picture_bytes: int = 100_000_000
    max_frames: int = 256
    pose_wait_s: float = 3.0
    max_waiting: int = 256
    max_pose_gap_s: float = 2.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("duration_s", 1, 3600),
            ("max_scan_points", 1, 100_000_000),
            ("max_cloud_points", 1, 100_000_000),
            ("max_picture_bytes", 1, 10_000_000_000),
            ("max_frames", 1, 10_000),
            ("pose_wait_s", 0, 60),
            ("max_waiting", 1, 100_000),
            ("max_pose_gap_s", 0.001, 60),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise PerceptionError(f"history.{name} = {value}: must be within {low}..{high}")


@dataclass(slots=True)
class HistoryCounters:
    """Since the start. expired: placed scans and clouds that made room for newer ones.

    without_pose: waited longer than pose_wait_s, or were taken before the first pose, or in a gap.
    overflowed: dropped because max_waiting others waited already.
    """

    scans: int = 0
    clouds: int = 0
    pictures: int = 0
    transforms: int = 0
    transforms_refused: int = 0
    expired: int = 0
    without_pose: int = 0
    overflowed: int = 0


@dataclass(frozen=True, slots=True)
class HistorySnapshot:
    """The history at one moment; never changes, and costs no copy.

    scans, clouds: blocks of points in the frame `world`, in order of arrival.
    cameras: per source the frames in order of time. calibrations: per camera frame_id the newest.
    """

    world: str = "map"
    scans: tuple[BlockView, ...] = ()
    clouds: tuple[BlockView, ...] = ()
    cameras: Mapping[str, tuple[CameraFrame, ...]] = field(default_factory=dict)
    disparities: tuple[Disparity, ...] = ()
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)
    tree: FrameTree = field(default_factory=FrameTree)


@dataclass(frozen=True, slots=True)
class _Waiting:
    item: RawScan | RawCloud
    arrived_ns: int


class History:
    """Takes sensors' data in, hands snapshots out. now_ns: any monotonic clock, for waiting only."""

    def __init__(self, limits: HistoryLimits | None = None, placement: ScanPlacement | None = None) -> None:
        self.limits = limits or HistoryLimits()
        self.placement = placement or ScanPlacement()
        self.counters = HistoryCounters()
        age_ns = round(self.limits.duration_s * _NS_PER_S)
        self._frames = Frames(
            age_ns + round(self.limits.pose_wait_s * _NS_PER_S),
            round(self.limits.max_pose_gap_s * _NS_PER_S),
            self.limits.max_frames,
        )
        self._scans = PointRing(self.limits.max_scan_points, age_ns)
        self._clouds = PointRing(self.limits.max_cloud_points, age_ns)
        self._pictures = PictureRing(self.limits.max_picture_bytes, age_ns)
        self._calibrations: dict[str, Calibration] = {}
        self._waiting: deque[_Waiting] = deque()

    def insert_transforms(self, transforms: Iterable[StampedTransform], now_ns: int) -> None:
        """Take poses, then place what has waited for them."""
        for transform in transforms:
            self._frames.insert(transform)
            self.counters.transforms += 1
        self.counters.transforms_refused = self._frames.refused
        self.settle(now_ns)

    def insert_scan(self, scan: RawScan, now_ns: int) -> None:
        """Place a scan, at once if the poses around it are known, or when they come."""
        self._wait(scan, now_ns)

    def insert_cloud(self, cloud: RawCloud, now_ns: int) -> None:
        """Place a cloud, at once or when its pose comes."""
        self._wait(cloud, now_ns)

    def insert_image(self, frame: CameraFrame) -> None:
        """Keep a camera's frame as it came."""
        self._pictures.append(frame)
        self.counters.pictures += 1

    def insert_disparity(self, disparity: Disparity) -> None:
        """Keep a disparity image; it becomes points when a view asks for them."""
        self._pictures.append(disparity)
        self.counters.pictures += 1

    def insert_calibration(self, calibration: Calibration) -> None:
        """Keep the newest calibration of a camera's frame."""
        if calibration.frame_id in self._calibrations or len(self._calibrations) < self.limits.max_frames:
            self._calibrations[calibration.frame_id] = calibration

    def settle(self, now_ns: int) -> None:
        """Place what waits and can be placed, in order of arrival; give up what has waited too long."""
        if not self._waiting:
            return
        tree = self._frames.snapshot()
        still: deque[_Waiting] = deque()
        for waiting in self._waiting:
            if not self._place(waiting.item, tree):
                if now_ns - waiting.arrived_ns > self.limits.pose_wait_s * _NS_PER_S:
                    self.counters.without_pose += 1
                else:
                    still.append(waiting)
        self._waiting = still

    @property
    def waiting(self) -> int:
        """How many scans and clouds wait for poses."""
        return len(self._waiting)

    def snapshot(self) -> HistorySnapshot:
        """All that is there now; from any thread."""
        return HistorySnapshot(
            self.placement.world,
            self._scans.views,
            self._clouds.views,
            self._pictures.cameras,
            self._pictures.disparities,
            self._calibrations.copy(),
            self._frames.snapshot(),
        )

    def _wait(self, item: RawScan | RawCloud, now_ns: int) -> None:
        self._waiting.append(_Waiting(item, now_ns))
        if len(self._waiting) > self.limits.max_waiting:
            self._waiting.popleft()
            self.counters.overflowed += 1
        self.settle(now_ns)

    def _place(self, item: RawScan | RawCloud, tree: FrameTree) -> bool:
        """Whether it is dealt with: placed, or found to be without a pose for ever."""
        try:
            first_ns, last_ns = tree.span_ns(self.placement.world, item.frame_id)
        except PoseError:
            return False  # not connected yet
        if item.end_ns > last_ns and item.start_ns >= first_ns:
            return False
        try:
            if isinstance(item, RawScan):
                self.counters.expired += self._scans.append(place_scan(item, tree, self.placement))
                self.counters.scans += 1
            else:
                self.counters.expired += self._clouds.append(place_cloud(item, tree, self.placement))
                self.counters.clouds += 1
        except PoseError:
            self.counters.without_pose += 1
        return True
