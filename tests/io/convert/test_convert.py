"""Which form a recording is written in."""

from pathlib import Path

from gvo.io.bag.source import BagSource
from gvo.io.convert.convert import convert
from gvo.io.datasets.euroc import EurocSource
from gvo.io.datasets.kitti import KittiSource
from gvo.io.datasets.tum import TumSource
from gvo.io.opening import open_recording
from tests.io.conftest import Item, ListSource, Tiny


def _pair(tiny: Tiny) -> ListSource:
    items: list[Item] = [(stream, 5, tiny.texture(stream)) for stream in (0, 1)]
    return tiny.stereo(items)


def _rgbd(tiny: Tiny) -> ListSource:
    return tiny.rgbd([(0, 5, tiny.texture(1)), (1, 5, tiny.depth(1))])


def test_a_folder_without_a_suffix_is_the_other_kind(tiny: Tiny, tmp_path: Path) -> None:
    convert(_pair(tiny), tmp_path / "bag")
    bag = open_recording(tmp_path / "bag")
    assert isinstance(bag, BagSource)
    convert(bag, tmp_path / "kitti")
    assert isinstance(open_recording(tmp_path / "kitti"), KittiSource)
    convert(_rgbd(tiny), tmp_path / "rgbd.mcap")
    convert(open_recording(tmp_path / "rgbd.mcap"), tmp_path / "tum")
    assert isinstance(open_recording(tmp_path / "tum"), TumSource)


def test_the_layout_decides_where_it_is_given(tiny: Tiny, tmp_path: Path) -> None:
    convert(_pair(tiny), tmp_path / "V1.01", layout="euroc")
    folder = open_recording(tmp_path / "V1.01")
    assert isinstance(folder, EurocSource)
    convert(folder, tmp_path / "again", layout="kitti")
    assert isinstance(open_recording(tmp_path / "again"), KittiSource)
    convert(_pair(tiny), tmp_path / "a.bag")
    convert(open_recording(tmp_path / "a.bag"), tmp_path / "b", layout="bag")
    assert isinstance(open_recording(tmp_path / "b"), BagSource)
