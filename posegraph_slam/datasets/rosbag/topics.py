"""Which topics of a bag give which stream: guessed from types and names, or as the user says."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from posegraph_slam.datasets.rosbag.bag import Bag, Topic
from posegraph_slam.errors import InputError, did_you_mean

LASER, ECHOES, CLOUD = (f"sensor_msgs/msg/{name}" for name in ("LaserScan", "MultiEchoLaserScan", "PointCloud2"))
ODOMETRY, IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu"
IMAGE, COMPRESSED, CAMERA = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSE, POSE_COVARIANCE, TRANSFORM = (
    f"geometry_msgs/msg/{name}" for name in ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
)

ROLES = {
    "scan": (LASER, ECHOES, CLOUD),
    "odom": (ODOMETRY,),
    "imu": (IMU,),
    "image": (IMAGE, COMPRESSED),
    "truth": (ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM),
}
"""Roles that a topic can have, and the message types that fit each, the first preferred."""
FRAME_ROLE = "base"
"""Names a frame and no topic: the robot's body."""
NONE = "none"
FROM_TRANSFORMS = ("tf", "/tf")
"""Named as the topic of odometry: its poses are those of the frame tree."""
TRUTH = re.compile(r"ground_?truth|(^|[/_])(gt|vicon|mocap|optitrack|truth)([/_]|$)", re.IGNORECASE)
ESTIMATE = re.compile(r"amcl|slam|filtered|map|gps|visual|vio", re.IGNORECASE)
"""Odometry of this name is another program's estimate, not what the wheels say: taken only when there is no other."""
REAR = re.compile(r"rear|back|left|right", re.IGNORECASE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """The topic of each role, None where there is none; `images` are all cameras; `base` the frame, where named."""

    scan: Topic | None
    odom: Topic | None
    imu: Topic | None
    truth: Topic | None
    images: tuple[Topic, ...]
    transforms: tuple[Topic, ...]
    base: str | None
    use_tf_odometry: bool

    def sentence(self, others: Sequence[Topic]) -> str:
        """Say which topics are used and how to choose others."""
        named = {"scan": self.scan, "odom": self.odom, "imu": self.imu, "truth": self.truth}
        used = ", ".join(f"{role} {topic}" for role, topic in named.items() if topic is not None) or "none"
        more = f"; also there: {', '.join(map(str, others))} (choose by --topic ROLE=NAME)" if others else ""
        return f"topics: {used}{more}"


def parse_topics(texts: Sequence[str]) -> dict[str, str]:
    """Turn `ROLE=NAME` options into a mapping; InputError naming the nearest role for an unknown one."""
    chosen: dict[str, str] = {}
    known = (*ROLES, FRAME_ROLE)
    for text in texts:
        role, equals, name = (part.strip() for part in text.partition("="))
        if not equals or not name:
            raise InputError(f"--topic {text}", "is not of the form ROLE=NAME", "for example --topic scan=/front/scan")
        if role not in known:
            guess = did_you_mean(role, known, cutoff=0.4)
            raise InputError(f"--topic {text}", f"'{role}' is no role", f"{guess}roles are {', '.join(known)}")
        chosen[role] = name
    return chosen


def choose(bag: Bag, wanted: Mapping[str, str]) -> Choice:
    """Give each role its topic: the one in `wanted` ("none" for no topic), else the likeliest by type and name.

    Raises InputError naming the topic, and listing those of the bag, where a wanted one is absent or of another type.
    """
    parse_topics([f"{role}={name}" for role, name in wanted.items()])  # the same checks for callers from Python

    def topic_of(role: str) -> Topic | None:
        if role in wanted:
            from_tree = role == "odom" and wanted[role] in FROM_TRANSFORMS
            return None if from_tree or wanted[role] == NONE else _named(bag, role, wanted[role])
        found = [topic for topic in bag.topics.values() if topic.type in ROLES[role] and topic.count]
        likely = [topic for topic in found if bool(TRUTH.search(topic.name)) == (role == "truth")]
        return min(likely, key=lambda topic: _rank(role, topic), default=None)

    cameras = [topic for topic in bag.topics.values() if topic.type in ROLES["image"] and topic.count]
    if "image" in wanted:
        only = topic_of("image")
        cameras = [] if only is None else [only]
    return Choice(
        scan=topic_of("scan"), odom=topic_of("odom"), imu=topic_of("imu"), truth=topic_of("truth"),
        images=tuple(cameras),
        transforms=tuple(topic for topic in bag.topics.values() if topic.type in TRANSFORMS),
        base=wanted.get(FRAME_ROLE),
        use_tf_odometry=wanted.get("odom", FROM_TRANSFORMS[0]) in FROM_TRANSFORMS,
    )  # fmt: skip


def unused(bag: Bag, choice: Choice) -> list[Topic]:
    """Return the topics that could have had a role but were not chosen."""
    used = {topic.name for topic in (choice.scan, choice.odom, choice.imu, choice.truth) if topic is not None}
    types = {kind for role, kinds in ROLES.items() if role not in ("image", "truth") for kind in kinds}
    return [topic for topic in bag.topics.values() if topic.type in types and topic.name not in used]


def _named(bag: Bag, role: str, name: str) -> Topic:
    topic = bag.topics.get(name) or bag.topics.get(f"/{name}") or bag.topics.get(name.lstrip("/"))
    if topic is None:
        guess = did_you_mean(name, bag.topics)
        raise InputError(bag.path, f"has no topic {name} for '{role}'", f"{guess}it holds {bag.listing()}")
    if topic.type not in ROLES[role]:
        fitting = ", ".join(kind.rsplit("/", 1)[-1] for kind in ROLES[role])
        problem = f"topic {topic.name} is a {topic.type}, which gives no '{role}'"
        raise InputError(bag.path, problem, f"it must be a {fitting}; the bag holds {bag.listing()}")
    if not topic.count:
        raise InputError(bag.path, f"topic {topic.name} has no messages", f"the bag holds {bag.listing()}")
    return topic


def _rank(role: str, topic: Topic) -> tuple[int, bool, bool, int, str]:
    """Order topics: preferred type, plain name, a name that fits, more messages, name."""
    plain = topic.name.rsplit("/", 1)[-1] in (role, {"odom": "odometry", "imu": "data"}.get(role, role))
    odd = bool((ESTIMATE if role == "odom" else REAR).search(topic.name))
    return ROLES[role].index(topic.type), odd, not plain, -topic.count, topic.name


def no_such_stream(path: Path, bag: Bag) -> InputError:
    """Return the error of a bag in which nothing can be read."""
    kinds = ", ".join(kind.rsplit("/", 1)[-1] for kind in (LASER, CLOUD, ODOMETRY, IMU))
    return InputError(path, f"holds no message of a type that is read ({kinds}, ...)", f"it holds {bag.listing()}")
