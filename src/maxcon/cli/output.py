"""Where results go: files replaced atomically, or standard output."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from maxcon.cli.errors import Failure, reported

#: Pictures that can be written, by suffix.
PICTURES = (".png", ".svg", ".pdf")


def check_output(out: str, option: str, suffixes: tuple[str, ...] = ()) -> None:
    """Make sure, before any work is done, that `out` can be written.

    Raises
    ------
    Failure
        If its folder does not exist or cannot be written to, it is a folder, or its suffix is none of `suffixes`.
    """
    if out == "-":
        return
    path = Path(out)
    if suffixes and path.suffix.lower() not in suffixes:
        endings = " or ".join(filter(None, (", ".join(suffixes[:-1]), suffixes[-1])))
        raise Failure(f"{option} must end in {endings}, but it is {out!r}")
    if path.is_dir():
        raise Failure(f"{option}: {out!r} is a folder, not a file")
    folder = Path(os.path.realpath(path)).parent
    if not folder.is_dir():
        raise Failure(f"{option}: there is no folder {str(folder)!r} to write {path.name!r} in")
    if path.exists() and not os.access(path, os.W_OK):
        raise Failure(f"{option}: {out!r} is write-protected")
    if not path.exists() or path.is_file():
        _try_folder(folder, option)


def check_folder(out: str, option: str) -> Path:
    """Make the folder `out` and return it; Failure if that cannot be done or nothing can be written there."""
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise Failure(f"{option}: {out!r} is a file, not a folder") from None
    except OSError as error:
        raise Failure(f"{option}: cannot make the folder {out!r}: {error.strerror}") from None
    _try_folder(folder, option)
    return folder


def check_matplotlib() -> None:
    """Make sure, before any work is done, that a picture can be drawn; Failure otherwise."""
    from maxcon.experiments.canvas import look  # noqa: PLC0415

    with reported(), look():
        pass


def write_output(out: str | Path, content: bytes) -> None:
    """Write `content`; a kill at any moment leaves the old file or the new one, never half of one.

    "-" is standard output. A link is followed, and what is no ordinary file (a pipe, a device) is written to as it is.
    """
    if str(out) == "-":
        sys.stdout.flush()
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()
        return
    path = Path(os.path.realpath(out))
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(content)
            return
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            part.write_bytes(content)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise Failure(f"cannot write {str(out)!r}: {error.strerror}") from None


def _try_folder(folder: Path, option: str) -> None:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise Failure(f"{option}: cannot write in the folder {str(folder)!r}: {error.strerror}") from None
