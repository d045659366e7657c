"""The same pairs as message_filters of ROS, compiled from the headers of the system's package."""

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import which

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gvo.io.recording import StampedImage
from gvo.io.sync import pair_images
from gvo.types import FaultyFrame

_HEADERS = ("message_filters/sync_policies/approximate_time.h", "ros/message_event.h")

_IS_THERE = which("g++") and all((Path("/usr/include") / name).exists() for name in _HEADERS)

pytestmark = [
    pytest.mark.acceptance,  # the compiler alone takes many seconds
    pytest.mark.ros1,
    pytest.mark.skipif(
        not _IS_THERE, reason="needs g++ and message_filters of ROS 1 (libmessage-filters-dev)"
    ),
]

# Reads a line per sequence: the limit, then stream and stamp of each image.
# Writes a line: for each pair the number of images pushed so far, and the places of both images
# within their streams.
_PROGRAM = r"""
#include <message_filters/sync_policies/approximate_time.h>
#include <message_filters/sync_policies/exact_time.h>

#include <iostream>
#include <sstream>

struct Image
{
  ros::Time stamp;
  int place;
};

namespace ros { namespace message_traits {
template <>
struct TimeStamp<Image>
{
  static ros::Time value(const Image& image) { return image.stamp; }
};
}}

typedef boost::shared_ptr<Image const> Pointer;
int n_pushed;

void print(const Pointer& first, const Pointer& second)
{
  std::cout << n_pushed << ' ' << first->place << ' ' << second->place << ' ';
}

template <class Policy>
void run(const Policy& policy, std::istream& words)
{
  message_filters::Synchronizer<Policy> synchronizer(policy);
  synchronizer.registerCallback(
      boost::bind(&print, boost::placeholders::_1, boost::placeholders::_2));
  int stream, counts[2] = {0, 0};
  uint64_t stamp_ns;
  n_pushed = 0;
  while (words >> stream >> stamp_ns)
  {
    auto image = boost::make_shared<Image>();
    image->stamp.fromNSec(stamp_ns);
    image->place = counts[stream]++;
    ++n_pushed;
    ros::MessageEvent<Image const> event(image, ros::Time(1));
    if (stream == 0)
      synchronizer.template add<0>(event);
    else
      synchronizer.template add<1>(event);
  }
  std::cout << std::endl;
}

int main()
{
  namespace policies = message_filters::sync_policies;
  std::string line;
  while (std::getline(std::cin, line))
  {
    std::istringstream words(line);
    int64_t limit_ns;
    words >> limit_ns;
    if (limit_ns == 0)
    {
      run(policies::ExactTime<Image, Image>(100), words);
      continue;
    }
    policies::ApproximateTime<Image, Image> policy(100);
    policy.setMaxIntervalDuration(ros::Duration().fromNSec(limit_ns));
    run(policy, words);
  }
}
"""
_LIBRARIES = ("message_filters", "roscpp", "rosconsole", "rostime", "boost_thread", "boost_system")

Message = tuple[int, int]  # stream and stamp, in the order of arrival
Pairs = list[tuple[int, int, int]]  # images pushed so far, places of both images in their streams
Reference = Callable[[list[Message], int], Pairs]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reference]:
    """Return a function that asks message_filters."""
    folder = tmp_path_factory.mktemp("message_filters")
    (folder / "pairs.cpp").write_text(_PROGRAM)
    libraries = [f"-l{name}" for name in _LIBRARIES]
    command = ["g++", "-O0", "-w", "-std=c++17", "pairs.cpp", "-o", "pairs", *libraries]
    subprocess.run(command, cwd=folder, check=True)
    with subprocess.Popen(
        [folder / "pairs"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # its warnings of images out of order
        text=True,
        bufsize=1,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        requests, answers = process.stdin, process.stdout

        def ask(messages: list[Message], limit_ns: int) -> Pairs:
            words = " ".join(f"{stream} {stamp_ns}" for stream, stamp_ns in messages)
            requests.write(f"{limit_ns} {words}\n")
            numbers = map(int, answers.readline().split())
            return list(zip(numbers, numbers, numbers, strict=True))

        yield ask
        process.stdin.close()


def _pairs(messages: list[Message], limit_ns: int) -> tuple[Pairs, Pairs]:
    """Return the pairs given while images came, and those given at the end."""
    images = [
        StampedImage(stream=k, stamp_ns=t, load=lambda: np.zeros((1, 1))) for k, t in messages
    ]
    places: dict[int, int] = {}
    for stream in (0, 1):
        own = [image for image in images if image.stream == stream]
        places |= {id(image): place for place, image in enumerate(own)}
    n_pushed, is_ended = 0, False

    def push() -> Iterator[StampedImage]:
        nonlocal n_pushed, is_ended
        for image in images:
            n_pushed += 1
            yield image
        is_ended = True

    found: tuple[Pairs, Pairs] = ([], [])
    for item in pair_images(push(), limit_ns=limit_ns, partner="x"):
        if not isinstance(item, FaultyFrame):
            places_of_pair = places[id(item[0])], places[id(item[1])]
            found[is_ended].append((n_pushed, *places_of_pair))
    return found


def _advancing(pairs: Pairs, messages: list[Message]) -> Pairs:
    """Leave out the pairs whose stamp does not advance: frames have increasing stamps."""
    stamps = [stamp_ns for stream, stamp_ns in messages if stream == 0]
    kept: Pairs = []
    for pair in pairs:
        if not kept or stamps[pair[1]] > stamps[kept[-1][1]]:
            kept.append(pair)
    return kept


def _check(
    reference: Reference, messages: list[Message], limit_ns: int, *, is_overflowing: bool = False
) -> int:
    """Compare with message_filters; return the number of pairs."""
    expected = _advancing(reference(messages, limit_ns), messages)
    while_coming, at_the_end = _pairs(messages, limit_ns)
    assert while_coming == expected
    if not is_overflowing:
        end_ns = max((stamp_ns for _, stamp_ns in messages), default=0) + 10**12
        ended = [*messages, (0, end_ns), (1, end_ns)]
        expected = _advancing(reference(ended, limit_ns), ended)
        places = [pair[1:] for pair in expected[:-1]]  # the last one is that of the end
        assert [pair[1:] for pair in while_coming + at_the_end] == places
    return len(expected)


_units = st.sampled_from([1, 37, 1_000_000])
_limits = st.sampled_from([0, 1, 5, 20, 60, 10_000])
_any_order = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 200)), max_size=40)
_crowded = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 12)), max_size=40)
_messages = st.one_of(
    _any_order, _crowded, _any_order.map(lambda messages: sorted(messages, key=lambda m: m[1]))
)


@settings(max_examples=300)
@given(messages=_messages, unit=_units, limit=_limits)
def test_the_pairs_are_those_of_message_filters_and_come_after_the_same_image(
    reference: Reference, messages: list[Message], unit: int, limit: int
) -> None:
    scaled = [(stream, stamp * unit) for stream, stamp in messages]
    _check(reference, scaled, limit * unit)


@pytest.mark.acceptance
@settings(max_examples=300)
@given(messages=_messages, limit=_limits, stream=st.integers(0, 1), n=st.integers(85, 120))
def test_queues_overflow_as_those_of_message_filters(
    reference: Reference, messages: list[Message], limit: int, stream: int, n: int
) -> None:
    alone = [(stream, k) for k in range(n)]
    _check(reference, [*alone, *messages], limit, is_overflowing=True)


def _camera_stamps(
    rng: np.random.Generator, rate: float, jitter_s: float, share_missing: float
) -> NDArray[np.int64]:
    """Return stamps of 3 s of a camera, some missing, repeated or out of order."""
    seconds = rng.choice([0.0, rng.uniform(0, 0.05)]) + 1 + np.arange(int(3 * rate)) / rate
    seconds += rng.normal(0, jitter_s, len(seconds))
    kept = seconds[rng.random(len(seconds)) >= share_missing]
    stamps = np.sort(1_700_000_000_000_000_000 + np.round(kept * 1e9).astype(np.int64))
    if rng.random() < 0.3:
        wrong = rng.integers(1, len(stamps), 3)
        stamps[wrong] = stamps[wrong - 1] - rng.integers(0, 2) * 10**8
    return stamps


@pytest.mark.acceptance
@pytest.mark.parametrize("rates", [(30, 30), (30, 15), (15, 30), (30, 10), (20, 29)])
def test_cameras_of_any_rates_are_paired_as_by_message_filters(
    reference: Reference, rates: tuple[int, int]
) -> None:
    rng = np.random.default_rng(rates)
    n_pairs = 0
    for _ in range(400):
        jitter_s, share_missing = rng.choice([0, 1e-4, 3e-3, 2e-2]), rng.choice([0, 0.03, 0.4])
        arrivals: list[tuple[float, int, int]] = []
        for stream, rate in enumerate(rates):
            stamps = _camera_stamps(rng, rate, jitter_s, share_missing)
            delays = rng.uniform(0, 1) * 1e9 + rng.exponential(rng.choice([1e5, 5e7]), len(stamps))
            arrived = np.maximum.accumulate(stamps + delays)  # bursts, but the stream's order
            arrivals += [(time, stream, int(t)) for time, t in zip(arrived, stamps, strict=True)]
        messages = [(stream, stamp_ns) for _, stream, stamp_ns in sorted(arrivals)]
        limit_ns = rng.choice([0, 2_000_000, 16_600_000, 20_000_000, 200_000_000])
        n_pairs += _check(reference, messages, int(limit_ns))
    assert n_pairs > 5000
