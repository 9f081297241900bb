"""Atomic files: complete or unchanged, without drafts left behind."""

import pytest

from fleet.errors import FleetError
from fleet.files import atomic_path, cache_folder, private_folder, user_cache_folder


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


def test_a_cache_is_private_to_its_owner(tmp_path, monkeypatch):
    (tmp_path / "open").mkdir(mode=0o777)
    for name in ("new/deep", "open"):
        assert private_folder(tmp_path / name).stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr("os.geteuid", lambda: 12345)
    with pytest.raises(FleetError, match="belongs to another user, who could run code as you"):
        private_folder(tmp_path / "open")
