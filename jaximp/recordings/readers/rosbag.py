"""Bags of ROS 1 and 2, and MCAP: a column is a topic and a field of its messages, `/joint_states.position.elbow`.

Of `sensor_msgs/JointState` a joint is called by its name. Every topic has a clock of its own, that of its headers:
`time` is that of the first topic that is named, and the others are joined on it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.claims import check_mcap
from jaximp.recordings.readers.columns import require, values_at
from jaximp.recordings.readers.found import Found
from jaximp.recordings.readers.library import library
from jaximp.types import Numbers

JOINT_FIELDS = ("position", "velocity", "effort")
GAP = 2.5
"""A topic is not joined across so many of its usual intervals."""
MOST_PLACES = 100
"""An array of a message that holds more numbers is no list of joints."""


def read(path: Path, names: Sequence[str]) -> Found:
    with _opened(path) as bag:
        topics = sorted({one.topic for one in bag.connections})
        of = {name: _topic(name, topics) for name in names}
        wanted = list(dict.fromkeys(topic for topic, _ in of.values() if topic))
        if not wanted:
            raise RecordingError(f"names no topic; there are: {', '.join(topics)}")
        fields = {topic: [field for one, field in of.values() if one == topic] for topic in wanted}
        series = {topic: _series(bag, topic, fields[topic]) for topic in wanted}
    base = series[wanted[0]][0]
    start = base[0]
    notes = [f"time is that of {wanted[0]}"] if len(wanted) > 1 else []
    values: dict[str, Any] = {}
    for name, (topic, field) in of.items():
        stamps, columns = series[topic or wanted[0]]
        column = (stamps - start) / 1e9 if field == "time" else columns[field]
        at, own = (base - start) / 1e9, (stamps - start) / 1e9
        order = np.argsort(own, kind="stable")
        values[name] = column if stamps is base else values_at(at, own[order], column[order], GAP)
    notes += [f"{topic} is joined on it, linearly between its {len(series[topic][0])} messages" for topic in wanted[1:]]
    return Found(values, notes=tuple(notes))


def _opened(path: Path) -> Any:
    highlevel = library("rosbags.highlevel", "rosbags", path.suffix)
    typesys = library("rosbags.typesys", "rosbags", path.suffix)
    if path.suffix == ".mcap":
        check_mcap(path)
    folder = path.parent if path.suffix != ".bag" and (path.parent / "metadata.yaml").exists() else path
    return highlevel.AnyReader([folder], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))


def _topic(name: str, topics: Sequence[str]) -> tuple[str, str]:
    """A column's topic and field; no topic for `time`."""
    if name == "time":
        return "", "time"
    for topic in sorted(topics, key=len, reverse=True):
        for spelled in (topic, topic.lstrip("/")):
            if name.startswith((spelled + ".", spelled + "/")):
                return topic, name[len(spelled) + 1 :].replace("/", ".")
    require(name, topics, f"the topic of column {name!r}")
    raise RecordingError(f"column {name!r} is a topic: name a field of its messages, such as {name}.position.elbow")


def _series(bag: Any, topic: str, fields: Sequence[str]) -> tuple[Any, dict[str, Numbers]]:
    """Stamps [ns] of a topic's messages, and the numbers of their fields."""
    connections = [one for one in bag.connections if one.topic == topic]
    stamps: list[int] = []
    found: dict[str, list[float]] = {field: [] for field in fields if field != "time"}
    for connection, received, raw in bag.messages(connections=connections):
        message = bag.deserialize(raw, connection.msgtype)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        sent = 0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec
        stamps.append(sent or received)
        for field, numbers in found.items():
            numbers.append(_number(message, field, topic))
    if not stamps:
        raise RecordingError(f"topic {topic!r} has no messages")
    return np.array(stamps), {field: np.array(numbers) for field, numbers in found.items()}


def _number(message: Any, field: str, topic: str) -> float:
    """One number of a message: `wrench.torque.z`, `position.elbow` or `position[2]`, which counts from 1."""
    value, joints = message, list(getattr(message, "name", []) or [])
    for step in re.findall(r"[^.\[\]]+", field):
        if hasattr(value, "__len__") and not isinstance(value, str):
            place = joints.index(step) if step in joints else int(step) - 1 if step.isdecimal() else -1
            if not 0 <= place < len(joints or value):
                require(step, joints or [str(k + 1) for k in range(len(value))], f"{field!r} of {topic}")
            value = value[place] if place < len(value) else np.nan
            continue
        if not hasattr(value, step):
            require(
                step,
                [one for one in getattr(value, "__dataclass_fields__", {}) if not one.startswith("_")],
                (f"field {step!r} of {topic}"),
            )
        value = getattr(value, step)
    if not isinstance(value, int | float | np.number):
        raise RecordingError(f"{topic}.{field} is no number; name a part of it, such as {topic}.{field}[1]")
    return float(value)


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """What the first message of every topic holds; of the parts of a joint state each joint by its name."""
    with _opened(path) as bag:
        found, seen = ["time"], set[str]()
        for connection, _, raw in bag.messages():
            if connection.topic not in seen:
                seen.add(connection.topic)
                message = bag.deserialize(raw, connection.msgtype)
                found += _numbers_in(message, connection.topic, list(getattr(message, "name", []) or []))
            if len(seen) == len({one.topic for one in bag.connections if one.msgcount}):
                break
    return dict.fromkeys(found, ())


def _numbers_in(value: Any, name: str, joints: Sequence[str]) -> Iterator[str]:
    """Names of the numbers in a message, or in a part of it."""
    if isinstance(value, int | float | np.number):
        yield name
    elif isinstance(value, np.ndarray | list | tuple):
        if len(value) <= MOST_PLACES and all(isinstance(one, int | float | np.number) for one in value):
            for k in range(len(value)):
                yield f"{name}.{joints[k]}" if k < len(joints) else f"{name}[{k + 1}]"
    else:
        for part in getattr(value, "__dataclass_fields__", {}):
            if part != "header" and not part.startswith("_"):
                yield from _numbers_in(getattr(value, part), f"{name}.{part}", joints)


def count(path: Path, names: Sequence[str]) -> int:
    with _opened(path) as bag:
        topics = sorted({one.topic for one in bag.connections})
        wanted = {_topic(name, topics)[0] for name in names}
        return max((one.msgcount for one in bag.connections if one.topic in wanted), default=0)
