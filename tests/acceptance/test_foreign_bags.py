"""Every command on every foreign bag: an answer or one line, never a traceback."""

from pathlib import Path

import pytest

from tests.conftest import Command

pytestmark = [pytest.mark.acceptance, pytest.mark.recorded]

COMMANDS = (
    ("check", "{}", "--json"),
    ("run", "{}", "--no-report", "--duration", "1", "--bag", "o.mcap"),
    ("convert", "{}", "c.mcap"),
    ("explain", "{}", "--frame", "0"),
    ("smooth", "{}"),
    ("compare", "{}#tf:a:b", "{}"),
)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_foreign_bag_gets_an_answer_or_one_line(
    command: Command,
    monkeypatch: pytest.MonkeyPatch,
    gvo_data: Path,
    tmp_path: Path,
    words: tuple[str, ...],
) -> None:
    bags = gvo_data / "bags"
    paths = sorted(bags.rglob("*"))
    assert len(paths) > 20
    for number, path in enumerate(paths):
        place = path.relative_to(bags)
        folder = tmp_path / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        answer = command(*(word.format(path) for word in words))
        errors = [line for line in answer.err.splitlines() if line.startswith("gvo: error: ")]
        assert answer.code in (0, 1, 2, 3), place
        assert len(errors) == (answer.code == 2), (place, answer.err)
        assert "Traceback" not in answer.err
        assert (answer.out + answer.err).replace("\n", "").isprintable()
