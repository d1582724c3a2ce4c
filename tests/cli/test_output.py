import os
import stat

import pytest

from maxcon.cli.errors import Failure
from maxcon.cli.output import PICTURES, check_folder, check_output, write_output


def test_write_replaces(tmp_path):
    path = tmp_path / "out.json"
    path.write_bytes(b"a longer text than the new one")
    write_output(str(path), b"new")
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["out.json"]


def test_the_old_file_stays_if_writing_fails(tmp_path, monkeypatch):
    path = tmp_path / "out.json"
    path.write_bytes(b"old")

    def broken(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(Failure, match="No space left on device"):
        write_output(str(path), b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.json"]


def test_a_link_is_followed(tmp_path):
    (tmp_path / "real.json").write_bytes(b"old")
    (tmp_path / "link.json").symlink_to("real.json")
    write_output(str(tmp_path / "link.json"), b"new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "real.json").read_bytes() == b"new"


def test_a_device_is_not_replaced():
    check_output(os.devnull, "--json")
    write_output(os.devnull, b"new")
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)


def test_checks(tmp_path):
    (tmp_path / "file").touch()
    check_output("-", "--json")
    check_output(str(tmp_path / "new.PNG"), "--plot", PICTURES)
    assert not (tmp_path / "new.PNG").exists()
    for out, suffixes, message in (
        (tmp_path, (), "is a folder"),
        (tmp_path / "none" / "out", (), "there is no folder"),
        (tmp_path / "file" / "out", (), "there is no folder"),
        (tmp_path / "out.gif", PICTURES, "--json must end in .png, .svg or .pdf, but it is"),
    ):
        with pytest.raises(Failure, match=message):
            check_output(str(out), "--json", suffixes)


def test_folders(tmp_path):
    assert check_folder(str(tmp_path / "a" / "b"), "--out").is_dir()
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(Failure, match="--out: "):
            check_folder(str(out), "--out")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="nothing is write-protected for root")
def test_write_protected(tmp_path):
    (tmp_path / "file").touch(mode=0o444)
    with pytest.raises(Failure, match="is write-protected"):
        check_output(str(tmp_path / "file"), "--json")
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(Failure, match="cannot write in the folder"):
            check_output(str(tmp_path / "new"), "--json")
    finally:
        tmp_path.chmod(0o755)
