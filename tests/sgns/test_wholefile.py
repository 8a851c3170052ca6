import os
import socket

import pytest

from sgns.errors import UserError
from sgns.wholefile import whole_file, write_whole


def test_a_file_is_replaced_whole(tmp_path):
    write_whole(tmp_path / "a", "old")
    with whole_file(tmp_path / "a") as hidden:
        hidden.write_text("new")
        assert (tmp_path / "a").read_text() == "old"
    assert (tmp_path / "a").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path):
    write_whole(tmp_path / "a", "old")
    with pytest.raises(KeyError), whole_file(tmp_path / "a") as hidden:
        hidden.write_text("half")
        raise KeyError
    assert (tmp_path / "a").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def a_pipe(path):
    os.mkfifo(path)


def a_socket(path):
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def a_device(path):
    try:
        os.mknod(path, 0o600 | 0o020000, os.makedev(1, 3))
    except OSError:
        pytest.skip("may not make devices here")


def a_link_to_a_device(path):
    path.symlink_to(os.devnull)


def a_link_to_a_file(path):
    path.with_name("file").write_text("old")
    path.symlink_to("file")


KINDS = [
    (a_pipe, "a pipe"),
    (a_socket, "a socket"),
    (a_device, "a device"),
    (a_link_to_a_device, "a symbolic link"),
    (a_link_to_a_file, "a symbolic link"),
    (os.mkdir, "a folder"),
]


@pytest.mark.skipif(os.name != "posix", reason="needs pipes and links")
@pytest.mark.parametrize(("make", "words"), KINDS)
@pytest.mark.parametrize("when", ["before", "meanwhile"])
def test_only_plain_files_are_replaced(tmp_path, make, words, when):
    path = tmp_path / "a"
    begun = False
    if when == "before":
        make(path)
    with pytest.raises(UserError, match=f"cannot write .*a: it is {words}"), whole_file(path) as hidden:
        begun = True
        hidden.write_text("new")
        make(path)
    assert begun == (when == "meanwhile")
    there = os.lstat(path).st_mode
    assert {p.name for p in tmp_path.iterdir()} <= {"a", "file"}
    path.rmdir() if words == "a folder" else path.unlink()
    make(path) if make is not a_link_to_a_file else path.symlink_to("file")
    assert os.lstat(path).st_mode == there  # it still was what it had been
    if make is a_link_to_a_file:
        assert (tmp_path / "file").read_text() == "old"
