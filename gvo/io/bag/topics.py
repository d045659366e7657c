"""Which topics of a bag hold the camera: by message type and name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from gvo.errors import RecordingError
from gvo.io.recording import Sensor

IMAGE_TYPE = "sensor_msgs/msg/Image"
COMPRESSED_TYPE = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (IMAGE_TYPE, COMPRESSED_TYPE)
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
IMU_TYPE = "sensor_msgs/msg/Imu"
NO_IMU = "none"
"""Chosen in place of the topic of an IMU: none is used."""

_COMPRESSED_SUFFIXES = ("/compressed", "/compressedDepth")
_NUMBERED = ("image_", "image_0", "image", "cam", "cam_", "camera", "camera_")
_SIDES = (
    ("left", "right"),
    *((f"{name}0", f"{name}1") for name in _NUMBERED),
    *((f"{name}1", f"{name}2") for name in ("infra", "fisheye")),
)
_COLOR = re.compile(r"rgb|colou?r")
# Depth, colour seen from the depth camera (`rgb_to_depth`), or both images of a ZED in one.
_NO_COLOR = re.compile(r"compressedDepth|_to_depth|/stereo(_raw)?/(image_r\w+_|color/r)")
_DEPTH = re.compile(r"(?<!_to_)depth")
# Where no name says depth: that of an OAK.
_DEPTH_OR_STEREO = re.compile(rf"{_DEPTH.pattern}|(?<![a-z])stereo/image_raw$")
# Not to another camera than the colour one: `aligned_depth_to_infra1`.
_REGISTERED = re.compile(r"(?<!un)(aligned|registered)(?!\w*_to_(?!rgb|colou?r))|_to_(rgb|colou?r)")
# Of the pixels of the camera as it is, not of the rectified ones.
_RAW_DEPTH = re.compile(r"depth.*raw$")
# at the start of a word: not in "unrectified" or "direct"
_RECTIFIED = re.compile(r"(?<![a-z])rect")
# How the images of one camera differ in name: not in the middle, as `camera_gray_left`.
_SORTS = re.compile(
    r"(?:(?<=/)|_|^)(raw|rect(ified)?)(?=[/_]|$)|(?:(?<=/)|_)(colou?r|mono|gr[ae]y)(?=/|$)"
)
_SIDE = re.compile(r"left|right")
_WORD = re.compile(r"[a-z]+|\d+")
# What the names of all topics of `CameraInfo` hold.
_OF_INFOS = {"camera", "cam", "info"}
_NEEDED = "gvo needs a stereo pair, or colour with depth (RGB-D)"
_FLAGS: dict[Sensor, tuple[str, str]] = {"stereo": ("left", "right"), "rgbd": ("color", "depth")}
_N_LISTED = 12
_Names: TypeAlias = tuple[str | None, str | None]
_Score: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """A topic of a bag: its name as recorded, its type in the form `package/msg/Name`."""

    name: str
    type: str
    n_messages: int

    @property
    def base(self) -> str:
        """The name without the suffix of a transport and outer slashes."""
        name = self.name
        for suffix in _COMPRESSED_SUFFIXES:
            name = name.removesuffix(suffix)
        return name.strip("/")

    @property
    def is_rectified(self) -> bool:
        """Whether the name says that the images are rectified."""
        return _RECTIFIED.search(self.base.lower()) is not None

    @property
    def is_registered(self) -> bool:
        """Whether the name says that depth is registered to colour."""
        return _REGISTERED.search(self.base.lower()) is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicChoice:
    """Topics that the user chose; None where the names decide."""

    left: str | None = None
    right: str | None = None
    color: str | None = None
    depth: str | None = None
    camera_info: tuple[str, ...] = ()
    imu: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTopics:
    """The two image topics of a camera: left and right, or colour and depth."""

    sensor: Sensor
    first: Topic
    second: Topic

    def describe(self) -> str:
        """Return one line for the list of decisions."""
        return (
            f"{self.sensor}: {self.first.name} + {self.second.name} "
            f"({self.first.n_messages} + {self.second.n_messages} messages)"
        )

    @property
    def flags(self) -> str:
        """What to type to choose them."""
        first, second = _FLAGS[self.sensor]
        return f"--{first} {self.first.name} --{second} {self.second.name}"


def choose_topics(topics: Sequence[Topic], choice: TopicChoice, where: str) -> CameraTopics:
    """Choose the image topics of one camera.

    A stereo pair is two topics that differ in left and right, image_0 and image_1, or the like;
    an RGB-D camera is one with rgb or colour (else any) in its name and one with depth. Of the
    topics of one camera, rectified ones are taken before raw ones, and these before compressed
    ones; with depth of raw pixels raw ones. Where the user chose one topic, its partner is found.

    Raises
    ------
    RecordingError
        When there is no camera, or more than one; with the candidates and what to type.
    """
    images = [topic for topic in topics if topic.type in IMAGE_TYPES]
    if not images:
        held = describe_topics(topics) or "no messages"
        raise RecordingError(f"{where}: holds no image topics; it holds {held}")
    sensor, names = _wanted(choice, where)
    chosen = [None if name is None else asked_topic(name, images, where, "image") for name in names]
    first, second = chosen
    if sensor is not None and first is not None and second is not None:
        return CameraTopics(sensor=sensor, first=first, second=second)
    candidates = [
        *_best(_fitting(_stereo_pairs(images), chosen) if sensor in (None, "stereo") else []),
        *_best(_fitting(_rgbd_pairs(images), chosen) if sensor in (None, "rgbd") else []),
    ]
    if not candidates and sensor != "stereo":
        candidates = _best(_fitting(_rgbd_pairs(images, is_found=False), chosen))
    if len(candidates) == 1:
        return candidates[0]
    given = first or second
    if given is not None and sensor is not None and not candidates:
        raise RecordingError(
            f"{where}: no partner of {given.name} is known by its name; give "
            f"--{_FLAGS[sensor][first is not None]} TOPIC, one of {describe_topics(images)}"
        )
    raise RecordingError(_explain(where, images, candidates))


def camera_info_topics(image: Topic, infos: Iterable[Topic]) -> list[tuple[_Score, Topic]]:
    """Return the topics of `CameraInfo` that may be of an image topic, by rank, best first.

    First those by their place, beside the image topic, below it, or beside or below its namespace,
    whose name says nothing that the image's does not. Then, of ranks that begin with one, those
    anywhere that do not contradict it, as raw ones do rectified images, right ones left images,
    and other numbers.
    """
    parent = image.base.rpartition("/")[0]
    grandparent = parent.rpartition("/")[0]
    places = [parent, image.base, grandparent, f"{grandparent}/info".strip("/")]
    words = {*_WORD.findall(image.base.lower())}
    against = {"left", "right", "rect", "rectified", "raw" if image.is_rectified else "rect"}
    found = []
    for topic in infos:
        said = {*_WORD.findall(topic.base.lower())} - _OF_INFOS
        place = topic.base.rpartition("/")[0]
        is_near = place in places and said <= words
        numbers = [any(map(str.isdigit, each)) for each in (said - words, words - said)]
        if is_near or not ((said - words) & against or all(numbers)):
            rank = places.index(place) if is_near else len(places)
            n_common, n_said = n_common_parts(image, topic), len(said & words)
            found.append(((not is_near, rank, -n_common, -n_said), topic))
    return sorted(found, key=lambda each: each[0])


def find_topic(name: str, topics: Iterable[Topic]) -> Topic | None:
    """Return the topic of a name, with or without the leading slash; None where there is none."""
    return next((topic for topic in topics if topic.name.strip("/") == name.strip("/")), None)


def asked_topic(name: str, topics: Sequence[Topic], where: str, kind: str) -> Topic:
    """Return the topic of a name that the user gave; refuse one that is not of its kind."""
    topic = find_topic(name, topics)
    if topic is None:
        held = describe_topics(topics) or "none"
        raise RecordingError(f"{where}: has no {kind} topic {name}; it has {held}")
    return topic


def describe_topics(topics: Sequence[Topic]) -> str:
    """Return the first topics with types and numbers of messages in one line; empty for none."""
    items = [f"{topic.name} ({topic.type}, {topic.n_messages})" for topic in topics[:_N_LISTED]]
    n_more = len(topics) - len(items)
    return ", ".join(items) + (f" and {n_more} more" if n_more else "")


def _wanted(choice: TopicChoice, where: str) -> tuple[Sensor | None, _Names]:
    stereo, rgbd = (choice.left, choice.right), (choice.color, choice.depth)
    if any(stereo) and any(rgbd):
        raise RecordingError(
            f"{where}: give --left and --right, or --color and --depth, not some of both"
        )
    if any(stereo):
        return "stereo", stereo
    return ("rgbd", rgbd) if any(rgbd) else (None, (None, None))


def _fitting(pairs: Iterable[CameraTopics], chosen: list[Topic | None]) -> Iterator[CameraTopics]:
    for pair in pairs:
        if chosen[0] in (None, pair.first) and chosen[1] in (None, pair.second):
            yield pair


def _stereo_pairs(images: Sequence[Topic]) -> Iterator[CameraTopics]:
    by_name = {topic.name.lower(): topic for topic in images if topic.n_messages > 0}
    for name, left in by_name.items():
        partners = {other for side in _SIDES for other in _other_side(name, *side)}
        for other in sorted(partners & by_name.keys()):
            if by_name[other].type == left.type:
                yield CameraTopics(sensor="stereo", first=left, second=by_name[other])


def _other_side(name: str, side: str, other: str) -> Iterator[str]:
    """Yield the name with one, or all, of the occurrences of a side replaced."""
    if side in name:
        yield name.replace(side, other)
    for match in re.finditer(side, name):
        yield name[: match.start()] + other + name[match.end() :]


def _rgbd_pairs(images: Sequence[Topic], *, is_found: bool = True) -> Iterator[CameraTopics]:
    """Yield colour with depth; where no camera is found otherwise, names that say less count."""
    usable = {topic.name.lower(): topic for topic in images if topic.n_messages > 0}
    words = _DEPTH if is_found else _DEPTH_OR_STEREO
    depths = [topic for topic in usable.values() if words.search(topic.base.lower())]
    others = [t for t in usable.values() if t not in depths and not _NO_COLOR.search(t.name)]
    colors = [topic for topic in others if _COLOR.search(topic.base.lower())]
    for color in colors if colors or is_found else others:
        # the depth of a stereo camera is that of its left one
        is_right = any(name in usable for name in _other_side(color.name.lower(), "right", "left"))
        for depth in depths:
            is_beside = is_found or n_common_parts(color, depth) > 0
            if is_beside and (not is_right or "right" in depth.name.lower()):
                yield CameraTopics(sensor="rgbd", first=color, second=depth)


def _best(pairs: Iterable[CameraTopics]) -> list[CameraTopics]:
    """Return the best pair of topics of each camera."""
    best: dict[str, CameraTopics] = {}
    for pair in pairs:
        camera = _camera_name(pair)
        if camera not in best or _score(pair) > _score(best[camera]):
            best[camera] = pair
    return list(best.values())


def _camera_name(pair: CameraTopics) -> str:
    """Return the place of a pair's first topic, without how images of one camera differ."""
    place = _SORTS.sub("", pair.first.base.lower().rpartition("/")[0])
    parts = [part for part in place.split("/") if part]
    if pair.sensor == "rgbd":
        parts = parts[: next((i for i, part in enumerate(parts) if _COLOR.search(part)), None)]
        if not _SIDE.search(pair.second.base.lower()):
            parts = [part for part in parts if part != "left"]
    return "/".join(parts)


def _score(pair: CameraTopics) -> _Score:
    is_color = bool(_COLOR.search(pair.first.base.lower()))
    score = (
        pair.first.is_rectified + pair.second.is_rectified,
        (pair.first.type == IMAGE_TYPE) + (pair.second.type == IMAGE_TYPE),
        -is_color,
    )
    if pair.sensor == "stereo":
        return score
    says_state = pair.second.is_rectified or _RAW_DEPTH.search(pair.second.base.lower())
    is_consistent = not says_state or pair.first.is_rectified == pair.second.is_rectified
    n_common = n_common_parts(pair.first, pair.second)
    return n_common, pair.second.is_registered, is_consistent, *score


def n_common_parts(first: Topic, second: Topic) -> int:
    """Return the number of parts with which the names of both begin."""
    parts = zip(first.base.split("/"), second.base.split("/"), strict=False)
    return next((n for n, (a, b) in enumerate(parts) if a != b), 0)


def _explain(where: str, images: Sequence[Topic], candidates: Sequence[CameraTopics]) -> str:
    if candidates:
        choices = " or ".join(candidate.flags for candidate in candidates)
        return f"{where}: holds more than one camera; choose {choices}"
    held = describe_topics(images)
    if len({_SORTS.sub("", topic.base.lower()) for topic in images}) == 1:
        return f"{where}: holds one camera alone, {held}; {_NEEDED}"
    return (
        f"{where}: {_NEEDED}, and none is known by the names of the image topics {held}; choose "
        "--left TOPIC --right TOPIC or --color TOPIC --depth TOPIC"
    )
