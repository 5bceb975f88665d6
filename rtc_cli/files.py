"""Files that appear whole or not at all, and checksums of folders.

Every write goes to a temporary name in the same folder, is flushed to the disk and renamed.
"""

import errno
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rtc_cli.errors import StateError

CHECKSUMS_NAME = "CHECKSUMS.json"

_REASONS = {
    errno.ENOSPC: ("the disk is full", "free some space or choose another folder, then run again"),
    errno.EDQUOT: ("the disk quota is used up", "free some space, then run again"),
    errno.EFBIG: ("the file would exceed the size limit", "raise the limit (ulimit -f)"),
    errno.EACCES: ("permission denied", "choose a folder that you may write to"),
    errno.EPERM: ("permission denied", "choose a folder that you may write to"),
    errno.EROFS: ("the file system is read-only", "choose a folder that you may write to"),
    errno.ENOENT: ("it does not exist", "check the path"),
    errno.ENOTDIR: ("a part of the path is a file, not a folder", "check the path"),
    errno.EISDIR: ("it is a folder, not a file", "check the path"),
    errno.EEXIST: ("it exists already", "choose another name or remove it"),
    errno.ENOTEMPTY: ("it exists already", "choose another name or remove it"),
}


def _read_umask() -> int:
    # Read once at import: asking sets it for a moment, which other threads would see.
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


_UMASK = _read_umask()


def os_error(error: OSError, path: Path | str | None = None) -> StateError:
    """Return the StateError that says in plain words what the system refused, and where."""
    where = path if path is not None else error.filename
    fallback = error.strerror or str(error) or type(error).__name__
    reason, hint = _REASONS.get(error.errno or 0, (fallback, ""))
    return StateError(f"{where}: {reason}" if where is not None else reason, hint)


def write_bytes(path: Path | str, data: bytes) -> None:
    """Write a whole file or nothing; creates missing parent folders. OSError becomes StateError."""
    path = Path(path)
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        temporary = Path(name)
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        _give_usual_mode(temporary, 0o666)
        os.replace(temporary, path)
        temporary = None
        _sync_folder(path.parent)
    except OSError as error:
        raise os_error(error, path) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_text(path: Path | str, text: str) -> None:
    """Write a whole UTF-8 text file or nothing."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path | str, obj: Any) -> None:
    """Write an object as readable JSON, whole or not at all; NaN and infinity are refused."""
    write_text(path, json.dumps(obj, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


@contextmanager
def new_folder(path: Path | str) -> Iterator[Path]:
    """Build a folder under a temporary name; rename it to `path` when the block ends well.

    On an error nothing stays behind. `path` must not exist, or be an empty folder.
    OSError becomes StateError.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise StateError(f"{path}: it exists already", "choose another name or remove it")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent))
        yield temporary
        _sync_tree(temporary)
        _give_usual_mode(temporary, 0o777)
        os.replace(temporary, path)
        temporary = None
        _sync_folder(path.parent)
    except OSError as error:
        raise os_error(error, path) from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def remove_remains(folder: Path | str) -> None:
    """Remove, anywhere in a folder, temporary files and folders of writers that were ended.

    Only where nobody else writes: what another process is building would go too.
    """
    for remains in list(Path(folder).rglob(".*.tmp")):
        if remains.is_dir() and not remains.is_symlink():
            shutil.rmtree(remains, ignore_errors=True)
        else:
            with suppress(OSError):
                remains.unlink()


def read_json(path: Path | str, what: str) -> Any:
    """Read a JSON file of ours; StateError naming it and `what` it is where it is damaged."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise os_error(error, path) from error
    except ValueError:
        raise StateError(
            f"{what} is damaged: {path} cannot be read", "remove that file, then run again"
        ) from None


def sha256_file(path: Path | str) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise os_error(error, path) from error


def write_checksums(folder: Path | str) -> None:
    """Write CHECKSUMS.json with the SHA-256 of every file in the folder; call it last."""
    folder = Path(folder)
    write_json(
        folder / CHECKSUMS_NAME,
        {"schema": 1, "sha256": {name: sha256_file(folder / name) for name in _files_in(folder)}},
    )


def verify_checksums(folder: Path | str, what: str) -> None:
    """Raise StateError naming the first file that is missing, changed or not listed.

    `what` says in the message what the folder is, as in "checkpoint".
    """
    folder = Path(folder)
    hint = f"the {what} cannot be trusted: restore or remove {folder}, then run again"
    if not folder.is_dir():
        raise StateError(f"{what} {folder} does not exist", "check the path")
    for name, digest in _read_checksums(folder, what).items():
        file = folder / name
        if not file.is_file():
            raise StateError(f"{what} is incomplete: {file} is missing", hint)
        if sha256_file(file) != digest:
            raise StateError(f"{what} is damaged: {file} does not match its checksum", hint)


def _read_checksums(folder: Path, what: str) -> dict[str, str]:
    file = folder / CHECKSUMS_NAME
    hint = f"restore or remove {folder}, then run again"
    try:
        listed = json.loads(file.read_text(encoding="utf-8"))["sha256"]
        names = set(listed)
    except FileNotFoundError:
        raise StateError(f"{folder} is no {what}: {CHECKSUMS_NAME} is missing", hint) from None
    except OSError as error:
        raise os_error(error, file) from error
    except (ValueError, KeyError, TypeError):
        raise StateError(f"{what} is damaged: {file} cannot be read", hint) from None
    extra = sorted(set(_files_in(folder)) - names)
    if extra:
        raise StateError(f"{what} is damaged: {folder / extra[0]} is not in its checksums", hint)
    return dict(listed)


def _files_in(folder: Path) -> list[str]:
    files = (file for file in folder.rglob("*") if file.is_file())
    names = (file.relative_to(folder).as_posix() for file in files)
    return sorted(name for name in names if name != CHECKSUMS_NAME)


def _give_usual_mode(path: Path, mode: int) -> None:
    # mkstemp and mkdtemp make private files; others should read results as usual.
    path.chmod(mode & ~_UMASK)


def _sync_folder(folder: Path) -> None:
    """Make a rename durable; a system that cannot sync folders is left alone."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(handle)


def _sync_tree(folder: Path) -> None:
    for file in folder.rglob("*"):
        if file.is_file():
            with open(file, "rb") as stream:
                os.fsync(stream.fileno())
