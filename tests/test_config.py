"""The configuration: reading, refusing, describing."""

import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from gvo.config import (
    Config,
    describe_configuration,
    list_parameters,
    load_configuration,
    values_by_name,
)
from gvo.errors import ConfigurationError


def write(folder: Path, text: str) -> Path:
    path = folder / "settings.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(path: Path | None = None, settings: tuple[str, ...] = ()) -> str:
    with pytest.raises(ConfigurationError) as caught:
        load_configuration(path, settings)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_file_sets_what_it_names(tmp_path: Path) -> None:
    path = write(tmp_path, "window:\n  size: 7\ndepth:\n  scale: 2000\n")
    config = load_configuration(path)
    assert config.window.size == 7
    assert config.depth.scale == 2000.0
    assert config.window.n_keyframes == Config().window.n_keyframes


def test_masks_are_named_from_the_folder_of_the_file(tmp_path: Path) -> None:
    path = write(tmp_path, "images:\n  mask: [left.png, /right.png]\n")
    config = load_configuration(path)
    assert config.images.mask == [str(tmp_path / "left.png"), "/right.png"]
    again = write(tmp_path, describe_configuration(config))
    assert load_configuration(again) == config
    assert values_by_name(config)["images.mask"] == f"{tmp_path / 'left.png'}, /right.png"
    assert "images.mask" in refusal(settings=("images.mask=[1.png, 2.png, 3.png]",))
    assert "mask" not in [each.key for each in list_parameters()["images"]]


def test_settings_win_over_the_file_and_later_ones_over_earlier(tmp_path: Path) -> None:
    path = write(tmp_path, "window:\n  size: 7\n  n_links: 4\n")
    config = load_configuration(path, ["window.size=8", " window.size = 9 "])
    assert (config.window.size, config.window.n_links) == (9, 4)


@pytest.mark.parametrize(
    ("setting", "nearest"),
    [
        ("window.sizee=5", "window.size"),
        ("depth.sigma=1", "depth.sigma_px"),
    ],
)
def test_an_unknown_key_names_the_nearest(setting: str, nearest: str) -> None:
    message = refusal(settings=(setting,))
    assert setting.partition("=")[0] in message
    assert f"did you mean {nearest}?" in message


def test_a_file_is_named_where_the_fault_is_in_it(tmp_path: Path) -> None:
    path, good = write(tmp_path, "window:\n  size: 1\n"), ("window.n_links=2",)
    assert refusal(path).startswith(f"{path}: window.size=1: ")
    assert refusal(path, good).startswith(f"{path}: window.size=1: ")
    assert refusal(path, ("window.size=3", "klt.x=1")).startswith(f"{path}: window.size=1: ")
    assert refusal(write(tmp_path, "window: {size: 3}\n"), ("klt.x=1",)).startswith("unknown key")


@pytest.mark.parametrize(
    ("setting", "key"),
    [
        ("window.size=1", "window.size"),
        ("depth.scale=.nan", "depth.scale"),
        ("stereo.max_depth_m=.inf", "stereo.max_depth_m"),
        ("ransac.seed=1.5", "ransac.seed"),
        ("features.kind=akaze", "features.kind"),
        ("window.size=five", "window.size"),
    ],
)
def test_values_out_of_range_are_refused_by_name(setting: str, key: str) -> None:
    assert refusal(settings=(setting,)).startswith(f"{key}=")


@pytest.mark.parametrize("section", ["depth", "stereo"])
def test_nearest_depth_must_lie_below_the_farthest(section: str) -> None:
    message = refusal(settings=(f"{section}.min_depth_m=5", f"{section}.max_depth_m=5"))
    assert f"{section}.min_depth_m=5.0" in message
    assert f"{section}.max_depth_m=5.0" in message


@pytest.mark.parametrize("setting", ["n_links=3", "window.n_links", "=3"])
def test_settings_of_another_form_are_refused_with_an_example(setting: str) -> None:
    assert "section.key=value" in refusal(settings=(setting,))


@pytest.mark.parametrize(
    "text", ["window: [1\n", "window:\n\tn_links: 3\n", "window: 2024-99-99\n"]
)
def test_a_file_that_is_no_yaml_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, text)
    assert str(path) in refusal(path)


@pytest.mark.parametrize("text", ["- 1\n", "just text\n", "window: 3\n", "1: {a: 2}\n"])
def test_a_file_that_holds_no_sections_is_refused(tmp_path: Path, text: str) -> None:
    assert "settings.yaml" in refusal(write(tmp_path, text))


def test_an_unreadable_file_is_refused_by_name(tmp_path: Path) -> None:
    missing = tmp_path / "nowhere.yaml"
    assert str(missing) in refusal(missing)
    assert str(tmp_path) in refusal(tmp_path)
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    assert str(binary) in refusal(binary)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("window.kernel_threshold", "null"),
        ("depth.icp", "auto"),
    ],
)
def test_a_parameter_that_has_gone_is_refused_with_its_fixed_value(key: str, value: str) -> None:
    message = refusal(None, (f"{key}=1",))
    assert message == f"{key} is no parameter any more: it is fixed at {value}"


def all_keys() -> list[tuple[str, str]]:
    return [(section, key) for section, values in Config().model_dump().items() for key in values]


def test_the_description_lists_every_key_with_a_meaning() -> None:
    text = describe_configuration(Config())
    for section, key in all_keys():
        block = text.split(f"\n{section}:\n")[1] if f"\n{section}:\n" in text else text
        line = next(line for line in block.splitlines() if line.startswith(f"  {key}: "))
        assert len(line.partition("  # ")[2]) > 10, line
    assert len(re.findall(r"^  \w+: ", text, re.MULTILINE)) == len(all_keys())
    assert not re.search(r"\b(nan|inf|None)\b", text)


def test_without_those_for_experts_the_few_and_the_changed_are_listed() -> None:
    config = load_configuration(settings=["window.gate=7", "klt.n_corners=300"])
    few = yaml.safe_load(describe_configuration(config, for_experts=False))
    assert few["window"] == {"size": 5, "n_keyframes": 20, "gate": 7.0}
    assert few["klt"] == {"n_corners": 300}
    assert sum(map(len, few.values())) <= 21
    assert Config.model_validate(few) == config


changed = st.fixed_dictionaries(
    {},
    optional={
        "depth": st.fixed_dictionaries({"scale": st.none() | st.floats(1e-9, 1e9)}),
        "features": st.fixed_dictionaries(
            {"kind": st.sampled_from(["orb", "sift", "fast", "gftt"]), "upright": st.booleans()}
        ),
        "stereo": st.fixed_dictionaries({"row_tolerance_px": st.floats(1e-300, 1e300)}),
        "window": st.fixed_dictionaries(
            {
                "size": st.none() | st.integers(2, 100),
                "keyframe_distance_m": st.floats(1e-300, 1e300),
                "kernel": st.sampled_from(["huber", "none", "dcs"]),
            }
        ),
    },
)


@given(values=changed)
def test_a_description_read_back_is_the_same_configuration(
    values: dict[str, object], tmp_path_factory: pytest.TempPathFactory
) -> None:
    config = Config.model_validate(values)
    path = write(tmp_path_factory.mktemp("described"), describe_configuration(config))
    assert load_configuration(path) == config
