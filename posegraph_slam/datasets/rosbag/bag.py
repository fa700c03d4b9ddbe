"""A bag opened through `rosbags`: its topics, and its messages one at a time, with every failure as one clear line."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from posegraph_slam.errors import InputError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC = b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\0"
STORAGES = (".mcap", ".db3")
METADATA = "metadata.yaml"
REPAIR = "copy it again, or repair it by `rosbag reindex` (ROS 1), `ros2 bag reindex` or `mcap recover` (ROS 2)"

QUOTED_MAX = 200
"""Errors of the bag library quote what they read, which may be any part of a damaged file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """One topic of a bag: its name, the type of its messages, and how many there are."""

    name: str
    type: str
    count: int

    def __str__(self) -> str:
        return f"{self.name} ({self.type.rsplit('/', 1)[-1]}, {self.count})"


@dataclass(frozen=True, slots=True, kw_only=True)
class RawMessage:
    """A message as it lies in the bag: topic, time of recording (ns) and bytes."""

    topic: str
    recorded_ns: int
    data: bytes


def is_bag(path: Path) -> bool:
    """Tell whether `path` is a bag file, or a folder that holds a ROS 2 bag, by names and first bytes."""
    try:
        if path.is_dir():
            metadata = path / METADATA
            described = metadata.is_file() and b"rosbag2_bagfile_information" in metadata.read_bytes()[:4096]
            return described or bool(_storage_files(path)) or bool(split_files(path))
        if path.suffix not in (".bag", *STORAGES):
            return False
        with path.open("rb") as file:
            return file.read(16).startswith((ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC))
    except OSError:
        return False


def split_files(folder: Path) -> list[Path]:
    """Return the .bag files of a folder, in the order of their names: the parts of a recording that was split."""
    return sorted(folder.glob("*.bag"))


def _storage_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix in STORAGES)


class Bag:
    """An open bag; `topics` by name. Made by `open_bag`."""

    def __init__(self, path: Path, reader: AnyReader) -> None:
        self.path = path
        self._reader = reader
        counts: dict[str, int] = {}
        types: dict[str, str] = {}
        for connection in reader.connections:
            counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
            types[connection.topic] = connection.msgtype
        self.topics = {name: Topic(name=name, type=types[name], count=counts[name]) for name in sorted(types)}

    @property
    def is_ros2(self) -> bool:
        """Whether messages are in CDR (ROS 2) and not in ROS 1's own form."""
        return bool(self._reader.is2)

    def listing(self) -> str:
        """Return the topics, their types and counts on one line."""
        return ", ".join(str(topic) for topic in self.topics.values()) or "no topic"

    def raw(
        self, topics: Collection[str], *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield the messages of `topics` in the order of their recording; InputError where the bag is damaged."""
        connections = [each for each in self._reader.connections if each.topic in topics]
        if not connections:
            return
        messages = self._reader.messages(connections, start=start_ns, stop=stop_ns)
        number = 0
        while True:
            # a damaged bag fails in every way that a parser, a decompressor or a database can
            try:
                connection, recorded_ns, data = next(messages)
            except StopIteration:
                return
            except Exception as error:
                names = ", ".join(sorted(topics))
                problem = f"is truncated or damaged after {number} messages of {names} ({first_line(error)})"
                raise InputError(self.path, problem, f"{REPAIR}; it lists {self.listing()}") from error
            number += 1
            yield RawMessage(topic=connection.topic, recorded_ns=recorded_ns, data=data)

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording (ns) and the deserialised message, in the order of recording."""
        for number, message in enumerate(self.raw(topics)):
            yield message.topic, message.recorded_ns, self.deserialise(message, number)

    def deserialise(self, message: RawMessage, number: int = 0) -> Any:
        """Return the message with its fields; InputError where its bytes do not fit its type."""
        topic = self.topics[message.topic]
        try:
            return self._reader.deserialize(message.data, topic.type)
        except KeyError as error:
            problem = f"topic {topic.name}: the bag does not describe its message type {topic.type}"
            raise InputError(self.path, problem, f"leave the topic out; the bag holds {self.listing()}") from error
        except Exception as error:  # bytes that are damaged fail in every way that a parser can
            problem = f"topic {topic.name}: message {number} is no {topic.type} ({first_line(error)})"
            raise InputError(self.path, problem, f"{REPAIR}; it holds {self.listing()}") from error


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag; InputError where it cannot be read.

    Bags of ROS 2 before Iron carry no message definitions: those of Humble are taken.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        # the reader keeps what it opened in one stack, closed even when opening fails halfway
        reader = AnyReader(_files(path), default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        bag = Bag(path, reader)
    except InputError:
        raise
    except Exception as error:
        problem = f"cannot be opened as a bag ({first_line(error)})"
        raise InputError(path, problem, f"it may be truncated: {REPAIR}") from error
    try:
        yield bag
    finally:
        reader.close()


def _files(path: Path) -> list[Path]:
    """Return what to open: the folder with its metadata, else all .bag files, else the one storage file in it."""
    if not path.is_dir() or (path / METADATA).is_file():
        return [path]
    if parts := split_files(path):
        return parts
    files = _storage_files(path)
    if len(files) != 1:
        names = ", ".join(file.name for file in files) or "none"
        raise InputError(path, f"has no {METADATA} and not one storage file ({names})", "run `ros2 bag reindex`")
    return files


def first_line(error: BaseException) -> str:
    """Return the first line of an error, at most `QUOTED_MAX` characters of it, or its name."""
    line = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
    return line if len(line) <= QUOTED_MAX else f"{line[:QUOTED_MAX]} ..."
