"""Files appear whole or not at all, under injected and real failures; checksums notice a byte."""

import errno
import os
import resource
import signal
import subprocess
import sys

import pytest

from rtc_cli.errors import StateError
from rtc_cli.files import (
    new_folder,
    sha256_file,
    verify_checksums,
    write_bytes,
    write_checksums,
    write_json,
)


def test_writes_and_replaces(tmp_path):
    path = tmp_path / "deep" / "file.bin"
    write_bytes(path, b"one")
    write_bytes(path, b"two")
    assert path.read_bytes() == b"two"
    assert os.listdir(path.parent) == ["file.bin"]


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.parametrize(("code", "words"), [(errno.ENOSPC, "full"), (errno.EACCES, "denied")])
def test_an_error_leaves_nothing_and_keeps_the_old_file(tmp_path, monkeypatch, call, code, words):
    path = tmp_path / "file.bin"
    write_bytes(path, b"old")

    def fail(*args):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(StateError, match=words) as caught:
        write_bytes(path, b"new")
    assert str(path) in str(caught.value)
    assert caught.value.exit_code == 3
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file.bin"]


def test_a_real_size_limit(tmp_path):
    path = tmp_path / "file.bin"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(StateError, match="size limit"):
            write_bytes(path, bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert os.listdir(tmp_path) == []


def test_json_refuses_nan(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "x.json", {"value": float("nan")})
    assert os.listdir(tmp_path) == []


def test_new_folder_appears_whole_or_not(tmp_path):
    target = tmp_path / "folder"
    with new_folder(target) as building:
        (building / "file").write_text("text")
        assert not target.exists()
    assert (target / "file").read_text() == "text"

    def build_badly():
        with new_folder(tmp_path / "bad") as building:
            (building / "file").write_text("text")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_badly()
    assert os.listdir(tmp_path) == ["folder"]


def test_new_folder_refuses_a_full_one(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").touch()
    with pytest.raises(StateError, match="exists"), new_folder(tmp_path / "folder"):
        pass


def test_killed_while_building_leaves_no_folder(tmp_path):
    code = (
        "import os, sys; from rtc_cli.files import new_folder\n"
        "with new_folder(sys.argv[1]) as f:\n"
        "    (f / 'x').touch(); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "folder")], check=False)
    assert not (tmp_path / "folder").exists()


def test_checksums(tmp_path):
    (tmp_path / "sub").mkdir()
    for name in ("a", "sub/b"):
        (tmp_path / name).write_bytes(b"content of " + name.encode())
    write_checksums(tmp_path)
    verify_checksums(tmp_path, "checkpoint")

    damaged = bytearray((tmp_path / "sub/b").read_bytes())
    damaged[3] ^= 1
    (tmp_path / "sub/b").write_bytes(damaged)
    with pytest.raises(StateError, match=r"sub/b.*checksum"):
        verify_checksums(tmp_path, "checkpoint")
    (tmp_path / "sub/b").unlink()
    with pytest.raises(StateError, match=r"sub/b.*missing"):
        verify_checksums(tmp_path, "checkpoint")


def test_checksums_notice_an_extra_and_an_unlisted_folder(tmp_path):
    with pytest.raises(StateError, match="no checkpoint"):
        verify_checksums(tmp_path, "checkpoint")
    write_checksums(tmp_path)
    (tmp_path / "extra").touch()
    with pytest.raises(StateError, match="extra"):
        verify_checksums(tmp_path, "checkpoint")
    with pytest.raises(StateError, match="does not exist"):
        verify_checksums(tmp_path / "none", "checkpoint")


def test_sha256_of_the_empty_file(tmp_path):
    (tmp_path / "empty").touch()
    # FIPS 180-4's value for the empty message.
    known = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    assert sha256_file(tmp_path / "empty") == known
