"""What lies behind a URL comes here whole and goes back whole; what fails says where."""

from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from gvo.batch.storage import Place, fetch, fetch_file, is_url, store
from gvo.errors import OutputError, RecordingError


class Hosted(MemoryFileSystem):  # type: ignore[misc]
    """Files that are found only by who names the host, as with FTP."""

    protocol = "hosted"
    store: dict[str, Any] = {}  # noqa: RUF012
    cachable = False

    def __init__(self, host: str, **options: Any) -> None:
        assert host == "anna@there"
        super().__init__(**options)

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(path).removeprefix("hosted://anna@there")

    @staticmethod
    def _get_kwargs_from_urls(path: str) -> dict[str, str]:
        return {"host": path.removeprefix("hosted://").partition("/")[0]}


class Broken(MemoryFileSystem):  # type: ignore[misc]
    """Files that fail in a way nobody here has heard of."""

    protocol = "broken"

    def exists(self, path: str, **options: Any) -> bool:
        raise LookupError("the cable is cut")

    put_file = makedirs = get = ls = exists


@pytest.fixture(autouse=True)
def protocols() -> None:
    for kind in (Hosted, Broken):
        fsspec.register_implementation(kind.protocol, kind, clobber=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "here"
    (folder / "deep").mkdir(parents=True)
    (folder / "a.txt").write_bytes(b"\x00\xff")
    (folder / "deep" / "b.txt").write_bytes(b"b")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture(params=["memory", "file"])
def url(request: pytest.FixtureRequest, memory: str, tmp_path: Path) -> str:
    return memory if request.param == "memory" else f"file://{tmp_path}/there"


def test_a_folder_comes_back_as_it_was_stored(url: str, folder: Path, tmp_path: Path) -> None:
    store(folder, f"{url}/run")
    (tmp_path / "copies").mkdir()
    copy = fetch(f"{url}/run", tmp_path / "copies")
    assert copy == tmp_path / "copies" / "run"
    assert contents(copy) == contents(folder)


def test_what_is_stored_again_replaces_what_was_there(url: str, folder: Path) -> None:
    store(folder, f"{url}/run")
    (folder / "deep" / "b.txt").write_bytes(b"new")
    store(folder, f"{url}/run")
    place = Place.of(f"{url}/run")
    assert {entry.name for entry in place.entries()} == {"a.txt", "deep"}
    assert {entry.name for entry in Place.of(f"{url}/run/deep").entries()} == {"b.txt"}
    assert place.files.cat_file(f"{place.path}/deep/b.txt") == b"new"


def test_a_file_is_fetched_under_its_own_name(url: str, folder: Path, tmp_path: Path) -> None:
    store(folder, url)
    (tmp_path / "copies").mkdir()
    copy = fetch(f"{url}/deep/b.txt", tmp_path / "copies")
    assert (copy.name, copy.read_bytes()) == ("b.txt", b"b")


def test_a_file_that_is_not_there_is_not_fetched(url: str, folder: Path, tmp_path: Path) -> None:
    store(folder, url)
    fetch_file(f"{url}/a.txt", tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == b"\x00\xff"
    fetch_file(f"{url}/none.txt", tmp_path / "none")
    assert not (tmp_path / "none").exists()
    with pytest.raises(RecordingError, match=r"none\.txt: does not exist"):
        fetch(f"{url}/none.txt", tmp_path)


def test_a_place_leads_back_to_itself_and_to_what_it_holds(url: str, folder: Path) -> None:
    store(folder, url)
    place = Place.of(f"{url}/deep/")
    assert place.location == f"{url}/deep"
    assert [entry.location for entry in place.entries()] == [f"{url}/deep/b.txt"]
    assert [one.location for one in Place.of(f"{url}/*.txt").matches()] == [f"{url}/a.txt"]
    assert Place.of(place.entries()[0].location).exists()


def test_user_and_host_of_a_url_stay(folder: Path) -> None:
    store(folder, "hosted://anna@there/x")
    place = Place.of("hosted://anna@there/x")
    assert place.location == "hosted://anna@there/x"
    (found,) = [entry for entry in place.entries() if not entry.is_folder()]
    assert found.location == "hosted://anna@there/x/a.txt"
    assert Place.of(found.location).exists()


def test_the_root_of_a_file_system_can_be_asked_for(memory: str, folder: Path) -> None:
    store(folder, memory)
    for url in ("memory://", "memory:///"):
        (found,) = Place.of(url).entries()
        assert Place.of(found.location).is_folder()
        assert found.name == "place"


def test_a_path_is_absolute_its_links_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for given in ("link/a.bag", "~/link/a.bag", "real/../link/a.bag", Path("link/a.bag")):
        assert Place.of(given).location == f"{tmp_path}/link/a.bag"


def test_a_url_is_told_by_its_protocol() -> None:
    assert all(is_url(one) for one in ("s3://a", "memory://", "zip://a::file:///b"))
    assert not any(is_url(one) for one in ("/a/b", "a::b", "C:/a", "s3:/a", Path("a//b")))


def test_what_may_not_be_read_is_told_in_words(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbid(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", "inside")

    monkeypatch.setattr("gvo.batch.storage.LocalFileSystem.ls", forbid)
    with pytest.raises(RecordingError, match=f"^{folder}: Permission denied$"):
        Place.of(folder).entries()


def test_whatever_fails_is_an_error_that_names_the_url(folder: Path) -> None:
    for fail in (
        lambda: fetch("broken://x/a", folder),
        lambda: fetch_file("broken://x/a", folder / "c"),
        lambda: Place.of("broken://x/a").entries(),
    ):
        with pytest.raises(RecordingError, match=r"^broken://x/a: .*the cable is cut"):
            fail()
    with pytest.raises(OutputError, match=r"^broken://x/a: .*the cable is cut"):
        store(folder, "broken://x/a")
    with pytest.raises(RecordingError, match=r"^nope://x: Protocol not known"):
        store(folder, "nope://x")
