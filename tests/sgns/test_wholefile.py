import pytest

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
