"""A user without HOME and without an entry in the system's list of users can run what needs no cache."""

import pwd

from bevcli.published import own_table, read_sources
from bevcli.writing import user_cache


def test_a_user_without_a_home_has_folders_that_are_not_there(monkeypatch):
    def unknown(user):
        raise KeyError(user)

    known = read_sources()
    for variable in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    assert not user_cache().exists()
    assert not own_table().exists()
    assert read_sources().keys() <= known.keys()
