"""Atomic files: complete or unchanged, without drafts left behind."""

import pytest

from fleet.files import atomic_path, cache_folder, user_cache_folder


def test_a_file_is_replaced_when_the_block_ends(tmp_path):
    path = tmp_path / "plan.bin"
    path.write_bytes(b"old")
    with atomic_path(path) as draft:
        draft.write_bytes(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_after_an_error_the_file_is_unchanged_and_the_draft_is_gone(tmp_path):
    path = tmp_path / "plan.bin"
    path.write_bytes(b"old")

    def interrupted():
        with atomic_path(path) as draft:
            draft.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_cache_folders_follow_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("THERMOFLEET_CACHE", raising=False)
    assert cache_folder() == user_cache_folder() == tmp_path / "thermofleet"
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    assert user_cache_folder() == tmp_path / "thermofleet"
