"""A sweep is the product of its values, and what is wrong with it is said in a line."""

import itertools
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.batch import make_variants
from gvo.errors import ConfigurationError


@given(
    st.lists(st.integers(2, 50), min_size=1, max_size=4, unique=True),
    st.lists(st.floats(0.125, 1e30), min_size=1, max_size=4, unique=True),
)
def test_values_are_taken_as_they_are_written(sizes: list[int], gates: list[float]) -> None:
    sweeps = [
        f"window.size={','.join(map(str, sizes))}",
        f"window.gate={','.join(map(repr, gates))}",
    ]
    variants = make_variants(sweeps=sweeps)
    found = [(config.window.size, config.window.gate) for config in variants.values()]
    assert found == list(itertools.product(sizes, gates))


def test_files_of_one_name_are_told_apart_and_one_file_is_one(tmp_path: Path) -> None:
    files = [tmp_path / place / "base.yaml" for place in "abc"]
    for size, file in enumerate(files, start=3):
        file.parent.mkdir()
        file.write_text(f"window: {{size: {size}}}\n")
    variants = make_variants([*files, files[0]])
    sizes = [(name, config.window.size) for name, config in variants.items()]
    assert sizes == [("base", 3), ("base-2", 4), ("base-3", 5)]


def test_who_asks_for_threads_gets_them(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("runtime: {threads: 3}\n")
    asked: list[dict[str, Any]] = [
        {"files": [tmp_path / "a.yaml"]},
        {"settings": ["runtime.threads=3"]},
        {"sweeps": ["runtime.threads=3"]},
    ]
    for one in asked:
        (config,) = make_variants(**one).values()
        assert config.runtime.threads == 3
    (config,) = make_variants(settings=["window.size=4"]).values()
    assert config.runtime.threads == 1


@pytest.mark.parametrize(
    ("sweep", "said"),
    [
        ("window.size", "expected section.key=a,b,c"),
        ("size=4,5", "--sweep size=4,5: expected section.key=a,b,c"),
        ("window.size='4", "no YAML"),
        ("window.size=!!python/object:os.system {}", "no YAML"),
        ("window.size=4,5,4", "4 is given twice"),
        ("window.size=2020-01-01", "no parameter has such a value"),
        ("window.size=4,1", "greater than or equal to 2"),
        ("window.sise=4", "did you mean window.size"),
    ],
)
def test_what_is_wrong_with_a_sweep_is_said_in_a_line(sweep: str, said: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        make_variants(sweeps=[sweep])
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_grid_that_has_no_end_is_refused_before_it_is_made() -> None:
    values = ",".join(map(str, range(2, 22)))
    keys = ("window.size", "window.n_links", "ransac.seed", "ransac.min_inliers")
    with pytest.raises(ConfigurationError, match="more than 100000 configurations"):
        make_variants(sweeps=[f"{key}={values}" for key in keys])
