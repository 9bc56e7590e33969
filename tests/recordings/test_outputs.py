"""Output folders are finished or not there."""

from pathlib import Path

import pytest

from jaximp.recordings.outputs import new_folder


def test_takes_its_name_when_finished(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with new_folder(out) as folder:
        (folder / "a").write_text("1")
        assert not out.exists()
    assert (out / "a").read_text() == "1"
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_nothing_is_left_of_a_failure(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError), new_folder(tmp_path / "out") as folder:
        folder.write_text("a folder is no file")
    assert list(tmp_path.iterdir()) == []


def test_an_older_folder_needs_force_and_survives_a_failure(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with new_folder(out) as folder:
        (folder / "old").touch()
    with pytest.raises(ValueError, match="pass --force"), new_folder(out):
        pass
    with pytest.raises(RuntimeError), new_folder(out, force=True):
        raise RuntimeError
    assert (out / "old").exists()
    with new_folder(out, force=True) as folder:
        (folder / "new").touch()
    assert not (out / "old").exists()
    assert (out / "new").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("make", [lambda p: p.write_text("x"), lambda p: (p.mkdir(), (p / "thesis.tex").touch())])
def test_force_replaces_only_what_was_made_here(tmp_path: Path, make) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "out"
    make(out)
    with pytest.raises(ValueError, match="was not made by jaximp"), new_folder(out, force=True):
        pass
    assert out.exists()


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="cannot be written"), new_folder(tmp_path / "file" / "out"):
        pass


def test_force_never_replaces_a_folder_that_holds_an_input(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with new_folder(out) as folder:
        (folder / "data.csv").touch()
    with pytest.raises(ValueError, match=r"holds the input data\.csv"), new_folder(out, True, [out / "data.csv"]):
        pass
    assert (out / "data.csv").exists()


def test_a_folder_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    folder = new_folder(out)
    folder.__enter__()
    out.mkdir()
    (out / "mine").touch()
    with pytest.raises(ValueError, match="exists"):
        folder.__exit__(None, None, None)
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "mine"]


def test_parents_of_a_failure_are_removed(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), new_folder(tmp_path / "a" / "b" / "out"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
